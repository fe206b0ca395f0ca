"""Jobs that measure the cost of accuracy: of the simulator, of the encoder, and end to end."""
