"""Call functions on the machines of a Ray cluster; the only importer of Ray."""
