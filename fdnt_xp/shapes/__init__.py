"""The shape of one galaxy, for a batch of them."""
