"""Model-predictive control of the car: one problem, three solvers, and what is safe where they have no answer."""
