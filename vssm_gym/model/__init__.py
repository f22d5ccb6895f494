"""Define the generative model ``p(x, z, M | u)``: transition, emission, their joint density and predictive samples."""
