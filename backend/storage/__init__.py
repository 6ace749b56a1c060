"""Rows in a database, arrays in a content-addressed store, and the documents that tie them together."""
