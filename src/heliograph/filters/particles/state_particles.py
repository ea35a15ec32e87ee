"""Particle filter of the state: weighted points for any plant, and any sensor and link whose noise has a density."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns, columns_of, join_columns, triangularise
from heliograph.factors.pivots import square_root
from heliograph.filters.base import Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.particles.base import (
    AbstractStateParticleFilter,
    Expectations,
    WeighedParticles,
    relative_to_largest,
    update_if_used,
)
from heliograph.filters.particles.expected_measurement import ExpectedMeasurement, InnovationSums
from heliograph.filters.particles.moments import StateSums, first_sums, second_sums
from heliograph.filters.particles.proposal import MoveLaw, factor_noise_covariance, propose_particles
from heliograph.filters.particles.received_density import ReceivedAtoms, find_received_density
from heliograph.filters.particles.resampling import draw_normals, effective_number, fold_in_bits
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import at, first, list_models_by_step, steps_covered, unstack, vary_over_steps
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.check import check_count, fail, instance, scalar
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, Bool, Float, Int
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian

Proposal = Literal["optimal", "prior"]
PROPOSALS: tuple[Proposal, ...] = ("optimal", "prior")
MANY = 1000


class StateParticles(NamedTuple):
    """Positions of N particles, their log weights, and the key of the next random numbers.

    `law` is that of the last move, of which a proposal that knows z makes other positions; None where there is no such
    proposal. `moved` is true from the first prediction on.

    Shapes: position (N, n), log_weight (N,), the largest 0, key (2,).
    """

    position: Float[jax.Array, "N n"]
    log_weight: Float[jax.Array, " N"]
    law: MoveLaw | None
    key: Int[jax.Array, " 2"]
    moved: Bool[jax.Array, ""]

    @property
    @in_float64
    def weight(self) -> jax.Array:
        """Weights (N,) of the particles, which sum to 1."""
        return jax.nn.softmax(self.log_weight)

    @property
    @in_float64
    def effective_number(self) -> jax.Array:
        """1 / sum of the squared weights: how many particles of equal weight would say as much."""
        return effective_number(self.weight)


class StateParticleFilter(AbstractStateParticleFilter):
    """Weighted particles of the whole state, which are drawn from the prior or with z. Built by `particle_filter`.

    Methods on particles take some of them (B, n), with their indices `numbers`, on which their draws depend. None
    stands for all particles; native code calls them for one particle in each SIMD lane.
    """

    uses_empty_rows = False

    def allocate_particles(self, count: int) -> np.ndarray:
        """Return an array for the positions of `count` particles (count, n), to be filled."""
        return np.zeros((count, len(self.states)))

    def get_particles(self, state: StateParticles) -> jax.Array:
        """Return the positions (N, n) of the particles: all that a particle of this filter is."""
        return state.position

    @compile_on_call
    def init(self) -> StateParticles:
        """Draw the particles from the law of x_0, with equal weights (log weights of 0).

        `moved` is False until a step is predicted.
        """
        key, start_key = self.start_keys()
        x = self.draw_start(start_key, jnp.arange(self.particles))
        return self.make_state(x, jnp.zeros(self.particles), key)._replace(moved=jnp.asarray(False))

    def make_state(self, position: jax.Array, log_weight: jax.Array, key: jax.Array) -> StateParticles:
        """Return the state of particles (N, n) with these log weights, after all noises were drawn.

        `law` is that of the last move, from which the optimal proposal may draw again. Here it has no spread left.
        """
        n = position.shape[1]
        law = MoveLaw(position, jnp.zeros((n, n)), jnp.zeros_like(position)) if self.optimal else None
        return StateParticles(position=position, log_weight=log_weight, law=law, key=key, moved=jnp.asarray(True))

    def draw_start(self, key: jax.Array, numbers: jax.Array) -> jax.Array:
        """Draw x_0 (B, n) of the particles of these numbers.

        Each number has a random key of its own, so that one particle's draw does not depend on how many there are.
        """
        plant = at(self.plant, k=0)

        def draw(number: jax.Array) -> jax.Array:
            """Draw x_0 of the particle of this number."""
            x_0: jax.Array = plant.sample_initial(jax.random.fold_in(key, number))
            return x_0

        drawn: jax.Array = jax.vmap(draw)(numbers)
        return drawn

    @predicts
    def predict(self, state: StateParticles, u: ArrayLike = (), k: Step = 0) -> StateParticles:
        """Resample if the effective number is too small, and then move each particle with a noise of its own.

        `law` is p(x+ | x) of each particle. The optimal proposal draws x+ again from it once z is known; for a filter
        that draws from the prior it is None.
        """
        key, choice_key, noise_key = self.keys_of_prediction(state.key)
        chosen, log_weight = self.choose_particles(state.log_weight, choice_key)
        all_numbers = None
        position, law = self.move_particles(
            state.position[chosen], all_numbers, noise_key, jnp.asarray(u), k, state.moved
        )
        return StateParticles(position=position, log_weight=log_weight, law=law, key=key, moved=jnp.asarray(True))

    def keys_of_prediction(self, key: jax.Array) -> jax.Array:
        """Return three keys (3, 2): of the correction, of the resampling, and of the process noise."""
        return jax.random.split(jax.random.fold_in(key, 0), 3)

    def move_particles(
        self, x: jax.Array, numbers: jax.Array | None, key: jax.Array, u: jax.Array, k: Step, moved: jax.Array
    ) -> tuple[jax.Array, MoveLaw | None]:
        """Return f(x, u) + w for B particles x, and the law of this move if the optimal proposal is to draw from it.

        A particle filter moves each particle x by the plant's law. The optimal proposal draws given the next
        measurement, and needs the law of the move for it.

        Args:
            x: particles (B, n).
            numbers: their indices (B,), on which their noise depends; None for all particles.
            key: of the noise.
            u: input.
            k: step.
            moved: False at the first step, where x is x_0.

        Returns:
            Positions, and the law m + G e with e ~ N(0, I): centers m, the root G of the noise's covariance, and e.
        """
        plant = at(self.plant, k)
        # f(x, u) of each particle.
        center = jax.vmap(lambda one: plant.transition(one, u))(x)
        # Noise that is not Gaussian is drawn from its law, by a key of each particle's index; there is no optimal
        # proposal.
        if isinstance(plant.noise, AbstractNoise) and not isinstance(plant.noise, Gaussian):
            all_numbers = jnp.arange(self.particles) if numbers is None else numbers
            noise = jax.vmap(lambda number: plant.sample_noise(jax.random.fold_in(key, number), u))(all_numbers)
            return wrap_angles(center + noise, plant.angles), None
        # Gaussian noise: m + G e, with m = f(x, u) + E w and G G' = Cov w.
        draws = draw_normals(key, numbers, x.shape[1], self.particles)
        center, root = center + plant.noise_mean(), _find_square_root(factor_noise_covariance(plant, u))
        position = wrap_angles(center + draws @ root.T, plant.angles)
        # The optimal proposal draws x+ given the measurement: it starts from this law, m + G e.
        if not self.optimal:
            return position, None
        return position, self._find_law_of_move(plant, moved, MoveLaw(center, root, draws), u)

    def _find_law_of_move(self, plant: AbstractPlant, moved: jax.Array, law: MoveLaw, u: jax.Array) -> MoveLaw:
        """Return the law of x+ of each particle, from which the optimal proposal draws once z is known.

        `law` is p(x+ | x): a center for each particle, the root of the noise's covariance, and draws. At the first step
        (`moved` is False) of a linear plant it is replaced by the law of A x_0 + w with a random x_0. Otherwise a
        measurement that is far more precise than x_0 would leave only few particles with weight.
        """
        if not isinstance(plant, LinearPlant) or plant.deviation is not None or plant.circular:
            return law
        start = at(self.plant, k=0)
        start_moved = columns_of(start.initial_covariance).through(plant.transition_matrix(u))
        mean = plant.transition(jnp.asarray(start.initial_mean), u) + plant.noise_mean()
        center = jnp.where(moved, law.center, mean)
        covariance = join_columns(start_moved, factor_noise_covariance(plant, u))  # of A x_0 + w
        root = jnp.where(moved, law.root, _find_square_root(covariance))
        return law._replace(center=center, root=root)

    @corrects
    def correct(self, state: StateParticles, z: ArrayLike, k: Step = 0) -> tuple[StateParticles, Innovation]:
        """Weight each particle by the density of z; under the optimal proposal each is first drawn again with z.

        `state.law` is the law p(x | x before) of the last move, from which it is drawn. A measurement that has no
        density under any particle is not used.
        """
        z = jnp.asarray(z)
        key, proposal_key = self.keys_of_correction(state.key, z)
        weighed = self.weigh_particles(state.position, state.law, numbers=None, key=proposal_key, z=z, k=k)
        log_likelihood = jax.nn.logsumexp(jax.nn.log_softmax(state.log_weight) + weighed.log_likelihood)
        log_weight = relative_to_largest(state.log_weight + weighed.log_likelihood)
        is_used = ~jnp.all(jnp.isnan(z)) & (log_likelihood > -jnp.inf)
        updated = self.make_state(weighed.particles, log_weight, key)._replace(moved=state.moved)
        corrected = update_if_used(is_used, updated, state._replace(key=key))
        return corrected, self.compute_innovation(state.weight, weighed.predicted, z, k, log_likelihood)

    def keys_of_correction(self, key: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the key of the next prediction, and that by which the proposal chooses particles to keep unchanged.

        They depend on z, so that runs with other data draw other numbers.
        """
        key = fold_in_bits(key, z)
        return key, jax.random.fold_in(key, 2)  # the prediction folds in 0

    def weigh_particles(
        self, position: jax.Array, law: MoveLaw | None, numbers: jax.Array | None, key: jax.Array, z: jax.Array, k: Step
    ) -> WeighedParticles:
        """Weigh particles (B, n) by p(z | x), after they are drawn again with z if the `law` of their move is given.

        A draw from q(x) instead of p(x) multiplies the weight by p(x) / q(x), whose log is `correction`. `numbers` are
        the indices of the particles, None for all. `predicted` (B, p) is h(x) before z was known.
        """
        sensor, atoms = at(self.sensor, k), self.find_received_atoms(z, k)
        predicted = signal = jax.vmap(sensor.measure)(position)
        correction = jnp.zeros(len(position))
        if law is not None:
            proposed = propose_particles(law, sensor, atoms, z, self.observed_angles, key, numbers, self.particles)
            position, correction = wrap_angles(proposed.position, at(self.plant, k).angles), proposed.correction
            signal = jax.vmap(sensor.measure)(position)
        likelihood = atoms.log_densities(signal, z, self.observed_angles) + correction
        return WeighedParticles(position, likelihood, (predicted,))

    def find_received_atoms(self, z: jax.Array, k: Step) -> ReceivedAtoms:
        """Return the Gaussians (atoms) whose mixture is the law of z given h(x), for the components that arrived.

        There is one mode, since the channel has no memory.
        """
        atoms_by_mode, _ = at(self.density, k).given_arrivals(z)
        atoms: ReceivedAtoms = jax.tree.map(lambda leaf: leaf[0], atoms_by_mode)
        return atoms

    def sum_received(
        self, reference: Expectations, weight: jax.Array, predicted: Expectations, z: jax.Array, k: Step
    ) -> InnovationSums:
        """Return weighted sums of the innovations d of z, and of d d', over B particles and the Gaussians of each.

        Given y = h(x), z is a mixture of Gaussians (atoms): a particle has an innovation z - E[z | y, atom] for each.
        That of the reference particle under the first atom is subtracted from all, so that no digits are lost if z is
        far from 0.

        Args:
            reference: one array, y (p,) of the heaviest particle.
            weight: of the particles before z is known (B,).
            predicted: one array, y of all particles (B, p).
            z: measurement (m,), NaN for what did not arrive.
            k: step.
        """
        (y_of_reference,), (y,) = reference, predicted
        expected = ExpectedMeasurement(self.find_received_atoms(z, k), z, y_of_reference, self.observed_angles)
        joint_weight, difference = expected.find_innovations(weight, y)
        return InnovationSums(
            first=first_sums(joint_weight, difference, angles=()), second=second_sums(joint_weight, difference)
        )

    def innovation_from_sums(
        self, received: InnovationSums, reference: Expectations, z: jax.Array, k: Step, density: jax.Array
    ) -> Innovation:
        """Return the innovation z - E z, its covariance Cov z, and log p(z).

        Args:
            received: sums over all particles, and over the Gaussians whose mixture is the law of z given y = h(x), of
                their innovations less the one of the reference particle.
            reference: one array, y (p,) of the reference particle, which gives the innovation that was subtracted.
            z: measurement (m,), NaN for what did not arrive.
            k: step.
            density: log p(z), found by the weights, and put into the result.
        """
        (y_of_reference,) = reference
        expected = ExpectedMeasurement(self.find_received_atoms(z, k), z, y_of_reference, self.observed_angles)
        return expected.compute_innovation(received, density)

    def sum_for_mean(self, weight: jax.Array, position: jax.Array) -> StateSums:
        """Return sums over B particles of weights, their squares, weighted positions (n,), and sines of angles.

        From those over all particles the mean follows. There are no modes (None).
        """
        return StateSums(first_sums(weight, position, first(self.plant).angles), None)

    def sum_for_covariance(self, weight: jax.Array, position: jax.Array, sums: StateSums) -> jax.Array:
        """Return sum_i w_i (x_i - mean)(x_i - mean)' (n, n) over B particles, about the mean of all particles.

        `sums` are those over all particles, by `sum_for_mean`; differences of angles are taken within half a turn.
        """
        angles = first(self.plant).angles
        return second_sums(weight, wrap_angles(position - sums.first.mean(angles), angles))

    def estimate_from_sums(self, sums: StateSums, second: jax.Array) -> Estimate:
        """Return the weighted mean and covariance; of an angle its mean direction, and second moments about it.

        `second` is the sum of w d d' (n, n) over all particles, with the weight w and the difference d from the mean.
        """
        return Estimate(sums.first.mean(first(self.plant).angles), second / sums.first.weight, self.claim)

    @estimates
    def estimate(self, state: StateParticles) -> Estimate:
        """Return the weighted mean and covariance; of an angle its mean direction, and second moments about it."""
        return self.compute_estimate(state)


def _find_square_root(columns: WeightedColumns) -> jax.Array:
    """Return a square root G (n, n) of a covariance W diag(w) W' given by its columns: G G' = W diag(w) W'."""
    factors = triangularise(columns)  # L and d of the same covariance L diag(d) L', so that G = L sqrt(d)
    return jnp.asarray(factors.matrix * square_root(factors.weights))


def build_state_particles(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, particles: int, seed: int, proposal: str, resample: float
) -> StateParticleFilter:
    """Return the particle filter that draws the whole state; check its arguments, which are those of `particle_filter`.

    A particle filter needs p(z | x), the density of what is received given the state, to weigh its particles. The
    claim, what its covariance is said to be, is "nominal": it is a sample's.

    Args:
        plant: the plant.
        sensor: its sensor.
        channel: from the sensor to the filter, without memory.
        particles: their number.
        seed: of the random numbers.
        proposal: "optimal" draws the next states given z, and needs Gaussian process noise; "prior" draws them from the
            plant alone.
        resample: share of `particles` below which the effective number leads to resampling.
    """
    start, first_sensor = instance("plant", first(plant), AbstractPlant, "a plant"), first(sensor)
    instance("sensor", first_sensor, AbstractSensor, "a sensor")
    first_sensor.refuse_inputs("particle_filter")
    check_link(first_sensor, first(channel), len(start.states), moments=False)
    if proposal not in PROPOSALS:
        raise fail("proposal", "'optimal' or 'prior'", repr(proposal))
    if proposal == "optimal":
        for step in unstack(plant):
            _check_gaussian(step)
    # p(z | x): one density if sensor and channel are the same at all steps, else one for each step.
    steps = steps_covered((sensor, channel)) or 1
    densities = [
        find_received_density([sensor_of_step], [channel_of_step])  # one mode
        for sensor_of_step, channel_of_step in zip(
            list_models_by_step(sensor, steps), list_models_by_step(channel, steps), strict=True
        )
    ]
    return StateParticleFilter(
        plant=plant,
        sensor=sensor,
        density=vary_over_steps(densities, sensor, channel),
        resample=np.asarray(scalar("resample", resample, low=0.0, high=1.0)),
        observed_angles=find_received_angles(plant, sensor, channel),
        particles=check_count("particles", particles),
        optimal=proposal == "optimal",
        seed=np.asarray(check_count("seed", seed, least=0)),
        **make_sizes("nominal", start, first(channel).outputs),
    )


def _check_gaussian(plant: AbstractPlant) -> None:
    """Raise ValueError unless the process noise is Gaussian, as the optimal proposal needs.

    A noise that is no law but a covariance depending on inputs counts as Gaussian.
    """
    if isinstance(plant.noise, AbstractNoise) and not isinstance(plant.noise, Gaussian):
        expected = "Gaussian process noise (proposal='prior' takes any)"
        raise fail("particle_filter with the optimal proposal", expected, type(plant.noise).__name__)
