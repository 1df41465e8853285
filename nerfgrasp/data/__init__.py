"""Training sets: packed arrays on disk, and the LightningDataModules that serve them."""
