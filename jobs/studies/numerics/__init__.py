"""What the numbers do at the ends of their ranges."""
