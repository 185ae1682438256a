"""The null tests: sheared weights, the tests with derivatives and noise, the root finder."""
