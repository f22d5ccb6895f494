"""Control the car by model prediction: one problem, three solvers, and safe commands where they have no answer."""
