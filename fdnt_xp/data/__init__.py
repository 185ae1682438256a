"""What comes in and goes out: images, catalogs, simulations."""
