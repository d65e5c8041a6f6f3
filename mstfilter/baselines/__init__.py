"""What MST is compared with: filters of the same parts that leave out what MST adds, and floors."""
