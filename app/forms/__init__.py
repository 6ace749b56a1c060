"""Forms made from JSON schemas: one control per setting, no stage known by name."""
