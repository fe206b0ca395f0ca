"""One checked configuration: every setting with its type, unit and range, and the errors about it."""
