"""Write runs to MCAP files, read them back, and replay them."""
