"""Drivers: one module per device family. They import thermocald.hal and thermocald.errors alone."""
