"""Runs that are killed, and runs that are left alone: what they leave, and whether they go on."""
