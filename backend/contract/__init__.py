"""Requests, answers and events: all that the UI (or any other client) may import of the backend."""
