"""Check that tests notice errors: apply each plausible one of a catalogue to a copy, and run its tests there."""
