"""Explore a plane with a laser scanner by the information of scans, estimated from samples of any model of scans."""
