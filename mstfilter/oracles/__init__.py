"""What is known to be right: worlds with an exact answer, and stages replaced by the truth of a recording."""
