"""Speed against accuracy, from one end to the other."""
