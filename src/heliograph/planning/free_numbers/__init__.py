"""Free numbers of a network that is a function of them: error, powers, derivatives, and designs."""
