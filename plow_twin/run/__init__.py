"""Functions and classes for users of the library. They compute whole motions and advance live twins."""
