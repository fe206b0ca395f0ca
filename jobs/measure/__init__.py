"""Jobs that measure what accuracy costs: of the simulator, of the encoder, and from end to end."""
