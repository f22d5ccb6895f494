"""Plan in a model of laser scans: a table of its ranges, random control sequences, and hybrid A* over both."""
