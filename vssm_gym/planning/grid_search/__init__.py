"""Search paths over the 16-neighbour graph of a clearance grid."""
