"""Device drivers, one module per family, built on thermocald.hal and thermocald.errors."""
