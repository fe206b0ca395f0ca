"""The settings of the simulated camera with which it does what a recorded one did."""
