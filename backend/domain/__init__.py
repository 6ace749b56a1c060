"""The application's words: ids, states, settings, view hints, patterns, shots, stages, methods, errors."""
