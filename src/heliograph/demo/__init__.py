"""The demonstration: recorded ranges through a simulated relay, to filters that know it or do not."""
