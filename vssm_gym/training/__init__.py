"""Train policies in a learned map or in the simulator, and evaluate them."""
