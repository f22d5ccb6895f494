"""Define the forms of actions, goals and images that an environment offers by keyword, and what varies by episode."""
