"""The calls for users of the library: whole motions and live twins, single or many at once."""
