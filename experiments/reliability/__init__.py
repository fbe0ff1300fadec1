"""Tests of reliability: runs that are killed and resumed, and runs of many hours."""
