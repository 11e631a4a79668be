"""What a bench file says of each kind of instrument."""
