"""What comes in and goes out: images, stamps, catalogs, simulated fields."""
