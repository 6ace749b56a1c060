"""Peers: what speaks a device's protocol from the other side, so that real drivers can be used without a laboratory."""
