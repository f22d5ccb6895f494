"""Train small policies by augmented random search, without gradients."""
