"""Powers of independent paths of hops: their information, convex bounds, and designs."""
