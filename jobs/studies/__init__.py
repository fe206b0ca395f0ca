"""Studies: what accuracy of the simulator and the encoder costs, and what a representation holds."""
