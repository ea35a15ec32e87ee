"""What waiting is worth: smoothing behind fading links and relays, from a lag of one step to a whole run."""

from heliograph.examples.smoothing.run import example as example
