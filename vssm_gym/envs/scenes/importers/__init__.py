"""Importers: foreign scene formats to `Apartment`."""
