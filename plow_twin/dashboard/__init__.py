"""The operator's screen: a web page, served by a separate process."""
