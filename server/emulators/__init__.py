"""Stand-ins that speak the bytes: a servo bus behind a pseudo-terminal and a DAQ behind gRPC, one plant behind both."""
