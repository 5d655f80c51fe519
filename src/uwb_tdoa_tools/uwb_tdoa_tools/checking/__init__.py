"""Find mistakes of drivers, surveys and clocks in recordings, before anything else uses them."""
