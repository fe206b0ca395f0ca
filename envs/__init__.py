"""The world, its sensor and the Gymnasium environment made of them."""
