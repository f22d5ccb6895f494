"""Import foreign scene formats as `Apartment`."""
