"""The operator's screen: a page in the browser, served by a separate process from a feed that may lose updates."""
