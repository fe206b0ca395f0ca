"""Run folders, their files and checkpoints, progress output, and Ray."""
