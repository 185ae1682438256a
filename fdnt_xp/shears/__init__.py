"""The shear of a population, from the shapes of its galaxies."""
