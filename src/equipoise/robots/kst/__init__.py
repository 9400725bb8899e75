"""KUKA iiwa behind the server of the KUKA Sunrise Toolbox (KST): codec, driver, emulated server."""
