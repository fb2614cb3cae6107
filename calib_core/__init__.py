"""The arithmetic of Gyrobench: arrays in, arrays out. No paths, clock, threads, network or global state."""
