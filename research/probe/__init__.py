"""What can be read from a representation by linear regression."""
