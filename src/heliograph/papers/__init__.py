"""Publications reproduced: one folder each, composed of the library's public parts only; nothing else imports them."""

METHODS: dict[str, str] = {  # the module whose `reproduce(out, runs, seed)` it is
    "cubature-fusion": "heliograph.papers.cubature_fusion.run",
    "successive-relays": "heliograph.papers.successive_relays.run",
    "quadratic-bias": "heliograph.papers.quadratic_bias.run",
    "h-infinity-fusion": "heliograph.papers.h_infinity_fusion.run",
    "intermittent-observations": "heliograph.papers.intermittent_observations.run",
}
