"""Measure how right the covariance of every filter is: one table of NEES, coverage, error and stated deviation."""
