"""A run on disk and on a machine: its folder, files, checkpoints, progress, and Ray."""
