"""Studies: the comparisons of the papers, ``vssm-gym study``."""
