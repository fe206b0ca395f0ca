"""The laws of the project. A package, because textstat installs another one of this name."""
