"""The operator's screen: a page in the browser, served by a process of its own."""
