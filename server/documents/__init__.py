"""A certificate as PDF, CSV and JSON."""
