"""One module a command of `gyrobench`: `add(parser)` and `main(args) -> int`."""
