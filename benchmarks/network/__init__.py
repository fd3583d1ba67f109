"""`sightline bench network`: robot and vision in two network namespaces with a shaped wire between."""
