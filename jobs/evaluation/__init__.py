"""Testing policies: held-out corridors, and sweeps over conditions."""
