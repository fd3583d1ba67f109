"""`sightline bench loop`: capture to the driver's verdict, against a floor and other designs."""
