"""Small worlds whose exact answers are known: what a filter ought to say, to hold it against what it says."""
