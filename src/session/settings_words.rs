//! The meaning of each setting of a session, in one line, and its unit.

/// The meaning and the unit of all settings whose key ends in [`Self::key`].
pub(super) struct Words {
    /// End of the key.
    pub key: &'static str,
    /// Unit; empty for a number without a unit and for a value that is not a number.
    pub unit: &'static str,
    /// Meaning in one line.
    pub meaning: &'static str,
}

const fn of(key: &'static str, unit: &'static str, meaning: &'static str) -> Words {
    Words { key, unit, meaning }
}

/// The words for a setting by the full path of its key. If several entries' keys are an end of the
/// path, the entry with the longest key counts; `None` if there is none.
pub(super) fn words(key: &str) -> Option<&'static Words> {
    let is_end = |words: &&Words| {
        key.strip_suffix(words.key).is_some_and(|above| above.is_empty() || above.ends_with('.'))
    };
    WORDS.iter().filter(is_end).max_by_key(|words| words.key.len())
}

const WORDS: [Words; 112] = [
    of("name", "", "Name of the session; its folder's by default"),
    of("seed", "", "Seed from which every random number follows"),
    of("model", "", "Model whose psi the search varies where no Qube is identified"),
    of("family", "", "Family of the distributions to which psi gives mean and standard deviation"),
    of("strategy", "", "Strategy of the search for psi"),
    of(
        "preset",
        "",
        "Preset that the training's settings come from; entries of [training] override it",
    ),
    of("psi.name", "", "Quantity that psi sets; docs/search.md lists them"),
    of(
        "psi.lower",
        "",
        "Lower end of the quantity's range, in the quantity's unit; the quantity's default if absent",
    ),
    of(
        "psi.upper",
        "",
        "Upper end of the quantity's range, in the quantity's unit; the quantity's default if absent",
    ),
    of("extent.initial_candidates", "", "Number of candidates before the search proposes its own"),
    of("extent.iterations", "", "Number of candidates that the search proposes"),
    of("extent.rollouts", "", "Number of rollouts of each candidate"),
    of("extent.verification_rollouts", "", "Number of rollouts that verify the recommendation"),
    of(
        "extent.verifies_incumbent",
        "",
        "Whether the best candidate's own policy gets as many rollouts of verification",
    ),
    of("extent.steps", "10 ms each", "Steps of a rollout"),
    of(
        "extent.repetitions",
        "",
        "Number of repetitions of a rollout after faults before the session stops or its rig is taken out",
    ),
    of(
        "extent.baseline",
        "",
        "Whether a policy of the nominal Qube is run once at the end, for comparison",
    ),
    of(
        "extent.pending",
        "",
        "Number of candidates that may still lack returns when the search proposes the next one; with 0, Qube and trainings wait for each other",
    ),
    of("identification.excitations", "", "Number of recordings under an excitation, of 10 s each"),
    of(
        "identification.excitation_v",
        "V",
        "Largest voltage of an excitation; for another plant, the voltage with the same effect on its arm",
    ),
    of("identification.candidates", "", "Largest number of candidates around the identified Qube"),
    of(
        "identification.rollouts",
        "",
        "Number of rollouts of each candidate around the identified Qube",
    ),
    of(
        "identification.spread",
        "fraction of each value",
        "Spread of the simulations in addition to the errors of the identification",
    ),
    of(
        "identification.trainings",
        "",
        "Number of trainings of each candidate, of which the best policy is kept",
    ),
    of("profile.spread", "fraction of each value", "Spread of the simulations around the profile"),
    of(
        "directions.M_p",
        "kg",
        "One direction of the errors: how far one standard deviation moves each quantity",
    ),
    of(
        "training.worst_share",
        "",
        "Part of the trajectories, the worst ones, that the second half of the updates learns from",
    ),
    of("corner_rad_s", "rad/s", "Corner of the velocity filter"),
    of(
        "observer.theta_noise_rad_s2",
        "rad/s^2",
        "Standard deviation of the model's error in the arm's acceleration",
    ),
    of(
        "observer.alpha_noise_rad_s2",
        "rad/s^2",
        "Standard deviation of the model's error in the pendulum's acceleration",
    ),
    of(
        "observer.reset_error_rad",
        "rad",
        "Largest prediction error of an angle; beyond it the observer restarts",
    ),
    of("safety_box.theta_rad", "rad", "Largest angle of the arm on either side"),
    of("safety_box.alpha_rad", "rad", "Largest angle of the pendulum on either side"),
    of("safety_box.theta_dot_rad_s", "rad/s", "Largest velocity of the arm"),
    of("safety_box.alpha_dot_rad_s", "rad/s", "Largest velocity of the pendulum"),
    of(
        "safety_box.guard",
        "",
        "Guard that ends a rollout: foresight, which simulates the brake in advance, or the box alone",
    ),
    of("simulation.safety_box.guard", "", "Guard of simulations: the box alone"),
    of("homing.method", "", "Method by which homing finds the arm's middle"),
    of("homing.theta_offset_rad", "rad", "Zero of theta relative to the middle between the stops"),
    of("homing.travel_rad", "rad", "Distance between this rig's stops"),
    of(
        "signs.theta_zero_counts",
        "counts",
        "Count of the arm's encoder at its zero; homing measures it",
    ),
    of(
        "signs.alpha_zero_counts",
        "counts",
        "Count of the pendulum's encoder while it hangs; homing measures it",
    ),
    of("signs.theta_inverted", "", "Whether the arm's encoder counts opposite to the convention"),
    of(
        "signs.alpha_inverted",
        "",
        "Whether the pendulum's encoder counts opposite to the convention",
    ),
    of(
        "signs.voltage_inverted",
        "",
        "Whether a positive voltage turns the arm towards negative theta",
    ),
    of(
        "emulated.command_jitter_s",
        "s",
        "Largest deviation of a command's delay from the emulated Qube's own",
    ),
    of("emulated.play_rad", "rad", "Backlash between motor and arm of the emulated Qube"),
    of("emulated.unidentified", "", "Whether the guard treats the emulated Qube as not identified"),
    of(
        "effects.presliding_rad",
        "rad",
        "Angle by which the arm's friction gives way like a spring before it slides",
    ),
    of("effects.stribeck", "fraction", "Part of the friction that is added near standstill"),
    of(
        "effects.hysteresis_n_m",
        "N m",
        "Largest torque of the cable's hysteresis, against the arm's last motion",
    ),
    of("effects.slack", "fraction", "Part of its stiffness that the cable lacks on one side"),
    of(
        "effects.warming_per_w",
        "1/W",
        "Part by which the winding's resistance grows for each watt that it loses",
    ),
    of(
        "effects.eccentricity_rad",
        "rad",
        "Largest error of the arm's encoder, which is off its centre",
    ),
    of("effects.tilt_rad", "rad", "Angle between the arm's axis and the vertical"),
    of(
        "effects.ripple",
        "fraction",
        "Largest deviation of the motor's torque from its mean over a turn",
    ),
    of("effects.pendulum_friction_n_m", "N m", "Dry friction in the pendulum's bearing"),
    of(
        "effects.cubic_n_m_rad3",
        "N m/rad^3",
        "Cubic term of the cable's torque, which makes it stiffer the farther it is bent",
    ),
    of("parameters.g", "m/s^2", "Gravitational acceleration"),
    of("parameters.R_m", "ohm", "Resistance of the motor"),
    of("parameters.k_m", "V s/rad", "Constant of the motor"),
    of("parameters.D_r", "N m s/rad", "Viscous damping of the arm"),
    of("parameters.D_p", "N m s/rad", "Viscous damping of the pendulum"),
    of("parameters.M_r", "kg", "Mass of the arm"),
    of("parameters.M_p", "kg", "Mass of the pendulum"),
    of("parameters.L_r", "m", "Length of the arm"),
    of("parameters.L_p", "m", "Length of the pendulum"),
    of(
        "gap.coulomb_torque_n_m",
        "N m",
        "Friction torque on the arm that is independent of velocity",
    ),
    of(
        "gap.positive_dead_zone_v",
        "V",
        "Part of a positive voltage that is lost before the motor turns",
    ),
    of(
        "gap.negative_dead_zone_v",
        "V",
        "Part of a negative voltage that is lost before the motor turns",
    ),
    of(
        "gap.cable_stiffness_n_m_rad",
        "N m/rad",
        "Stiffness with which the cable pulls the arm towards its rest angle",
    ),
    of("gap.cable_rest_rad", "rad", "Angle of the arm at which the cable does not pull"),
    of("gap.command_delay_s", "s", "Time from a command to its arrival at the motor"),
    of(
        "gap.cable_drift_rad_per_min",
        "rad/min",
        "Drift of the cable's rest angle, of the emulated Qube alone",
    ),
    of("bayrn.initial_design", "", "Sampling of the initial candidates"),
    of("bayrn.acquisition", "", "Acquisition function that the next candidate maximises"),
    of("bayrn.beta", "", "Weight of the standard deviation in upper-confidence-bound"),
    of("bayrn.incumbent", "", "Reference value of an improvement"),
    of("bayrn.noise", "", "Noise model of mean returns"),
    of("surrogate.kernel", "", "Covariance function of the Gaussian process"),
    of("surrogate.mean", "", "Prior mean of the Gaussian process"),
    of("surrogate.priors", "", "Priors of the Gaussian process's hyperparameters"),
    of("surrogate.starts", "", "Number of starts of the hyperparameters' optimiser"),
    of("surrogate.seed", "", "Seed of the random starts, combined with the session's"),
    of("training.updates", "", "Number of updates: rounds of collecting and optimising"),
    of("training.num_envs", "", "Number of pendulums simulated in parallel"),
    of("training.epochs", "", "Passes over the transitions of an update"),
    of("training.learning_rate", "", "Adam's learning rate in the first update"),
    of(
        "training.last_learning_rate",
        "",
        "Rate towards which Adam's learning rate falls linearly, reached only after the last update",
    ),
    of("training.discount", "", "Discount factor gamma"),
    of("training.gae_lambda", "", "Lambda of generalised advantage estimation"),
    of("training.clip", "", "Clip range epsilon of PPO's clipped objective"),
    of("training.entropy_weight", "", "Weight of the entropy bonus"),
    of(
        "training.kl_weight",
        "",
        "Weight of the divergence from the policy that collected the batch",
    ),
    of("training.largest_gradient_norm", "", "Norm to which a longer gradient is scaled down"),
    of("training.adam_beta_1", "", "Adam's decay of the first moment"),
    of("training.adam_beta_2", "", "Adam's decay of the second moment"),
    of("training.adam_epsilon", "", "Adam's epsilon"),
    of(
        "training.adam_epsilon_beside_root",
        "",
        "Whether epsilon is added to the root of the second moment instead of under it",
    ),
    of("training.first_log_std", "", "Initial logarithm of the policy's standard deviation"),
    of(
        "training.smallest_log_std",
        "",
        "Lower bound of the logarithm of the policy's standard deviation",
    ),
    of(
        "training.voltage_change_weight",
        "1/V^2",
        "Weight of a change of voltage in the training reward",
    ),
    of(
        "training.evaluation_starts",
        "",
        "Number of fixed starts in the evaluation after each update",
    ),
    of("training.target_return", "", "Mean return of an evaluation at which training ends early"),
    of("training.threads", "", "Number of threads to use; the policy does not depend on it"),
    of("simulation.history", "", "Number of last commands in the observation"),
    of(
        "sensors.type",
        "",
        "Sensors of the simulation: true states, or encoders with the estimator below",
    ),
    of("reward.theta", "1/rad^2", "Weight of the arm's angle in the reward"),
    of("reward.alpha", "1/rad^2", "Weight of the pendulum's angle in the reward"),
    of("reward.theta_dot", "s^2/rad^2", "Weight of the arm's velocity in the reward"),
    of("reward.alpha_dot", "s^2/rad^2", "Weight of the pendulum's velocity in the reward"),
    of("reward.voltage", "1/V^2", "Weight of the voltage in the reward"),
];
