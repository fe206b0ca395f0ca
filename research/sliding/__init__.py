"""What a camera that slides sideways tells of the depth before it, recorded and simulated."""
