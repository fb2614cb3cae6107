"""The rigs: a small protocol for tables and DAQs, and what implements it."""
