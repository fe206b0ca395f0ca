"""Search for settings: the space, a trial, and the search."""
