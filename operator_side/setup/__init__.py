"""What is set up once: keys, services that start with the machine, a router."""
