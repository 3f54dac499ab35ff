//! One episode of the real tick (estimator, guard, brake and limit) against a plant with a delay,
//! from settling until the amplifier is off and the arm has coasted.

use std::collections::VecDeque;

use qube_hil::control::{Motion, Tick, TickInput};
use qube_hil::estimation::{Calibration, EstimatorSettings};
use qube_hil::policy::Controller;
use qube_hil::qube::{Measurement, RAD_PER_COUNT, State, Status};
use qube_hil::safety::SafetyBox;
use qube_hil::telemetry::{Ending, TickSettings};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use super::plant::{Plant, Roughness};

/// Number of genes of an adversary: its Qube, its delays, its policy, its start.
pub const GENES: usize = 25;

pub type Genome = [f64; GENES];

/// The limits within which the adversary chooses.
#[derive(Clone, Copy, Debug)]
pub struct Domain {
    /// Largest relative deviation of the parameters from nominal.
    pub spread: f64,
    /// Longest time from a sample to its act, s.
    pub longest_delay_s: f64,
    /// True if the arm has friction and a cable.
    pub rough: bool,
    /// Corner of the estimator's filter, rad/s.
    pub corner_rad_s: f64,
    /// Guard of the Qube.
    pub safety_box: SafetyBox,
}

/// The domain for which SAFETY.md promises safety.
pub const PROMISED: Domain = Domain {
    spread: 0.3,
    longest_delay_s: 0.02,
    rough: true,
    corner_rad_s: 200.0,
    safety_box: SafetyBox::GUARDED,
};

/// Result of an episode.
#[derive(Clone, Copy, Debug)]
pub struct Episode {
    /// Largest |theta|, rad.
    pub farthest_rad: f64,
    /// Time of the largest |theta|, s.
    pub farthest_at_s: f64,
    /// Largest magnitude of a voltage sent, mV.
    pub largest_mv: i16,
    /// Ending that the tick reported.
    pub ending: Option<Ending>,
    /// Number of the tick that reported the ending, from 0.
    pub last_tick: u32,
}

/// Largest angle at which the cable begins to pull, rad. No controller can hold an arm that a cable
/// pulls into its stop while the amplifier is off.
const CABLE_REACH_RAD: f64 = 0.3;

/// Largest number of steps of the policy.
const STEPS: u32 = 250;

/// Ticks for which the arm coasts with the amplifier off.
const COASTING_TICKS: u32 = 300;

/// A policy at full voltage: it pumps by the sign of a weighted sum over the state, then pushes one
/// way, the other way, and the first way again. Weights and switching times are genes.
struct Adversary {
    genes: Genome,
    step: u32,
}

impl Controller for Adversary {
    fn voltage_v(&mut self, state: &State) -> f64 {
        let genes = &self.genes;
        let span =
            |gene: usize, longest: f64| (0.5 * (genes[gene].clamp(-1.0, 1.0) + 1.0)) * longest;
        let time_s = f64::from(self.step) * 0.01;
        self.step += 1;
        let (sin, cos) = state.alpha.sin_cos();
        let pumping_s = span(14, 2.0);
        let pushing_s = pumping_s + span(15, 0.5);
        let pulling_s = pushing_s + span(16, 0.5);
        let form = genes[17] * state.theta
            + genes[18] * sin
            + genes[19] * 0.2 * state.theta_dot
            + genes[20] * 0.1 * state.alpha_dot * cos
            + genes[21] * cos
            + genes[22] * 0.1 * state.alpha_dot;
        let direction = if time_s < pumping_s {
            form
        } else if time_s < pushing_s || time_s >= pulling_s {
            genes[23]
        } else {
            -genes[23]
        };
        // The voltage is larger than allowed, so that the limit on the voltage acts.
        if direction > 0.0 { 8.0 } else { -8.0 }
    }
}

/// Plays one episode; the same arguments give the same episode.
pub fn play(genes: &Genome, domain: &Domain, seed: u64) -> Episode {
    let bounded = |gene: usize| genes[gene].clamp(-1.0, 1.0);
    let share = |gene: usize| 0.5 * (bounded(gene) + 1.0);
    let factors = std::array::from_fn(|gene| 1.0 + domain.spread * bounded(gene));
    let roughness = if domain.rough {
        Roughness {
            coulomb_v: 0.15 * share(11),
            cable_v_rad: 0.2 * bounded(12),
            cable_theta: CABLE_REACH_RAD * bounded(13),
        }
    } else {
        Roughness::default()
    };
    let start_theta_rad = 0.1 * bounded(24);
    let mut plant = Plant::new(&factors, roughness, start_theta_rad);
    let settings = TickSettings {
        calibration: Calibration::IDENTITY,
        estimator: EstimatorSettings::filter(domain.corner_rad_s),
        safety_box: domain.safety_box,
        max_steps: STEPS,
        start_theta_rad,
        stops: None,
        foresight: None,
        rules: qube_hil::telemetry::TickRules::NEWEST,
        plant: qube_hil::qube::PlantModel::QUBE,
    };
    let mut tick = Tick::new(&settings, Adversary { genes: *genes, step: 0 });
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut acts: VecDeque<(f64, i16)> = VecDeque::with_capacity(8);
    let mut sent_at_s = 0.0_f64;
    let mut episode = Episode {
        farthest_rad: 0.0,
        farthest_at_s: 0.0,
        largest_mv: 0,
        ending: None,
        last_tick: 0,
    };
    let mut applied_mv = 0;
    for number in 0_u32.. {
        let now_s = f64::from(number) * 0.01;
        while let Some(&(at_s, voltage_mv)) = acts.front()
            && at_s <= now_s
        {
            acts.pop_front();
            plant.advance_to(at_s);
            plant.set_voltage(f64::from(voltage_mv) / 1000.0);
            applied_mv = voltage_mv;
        }
        plant.advance_to(now_s);
        if episode.ending.is_some() {
            if number > episode.last_tick + COASTING_TICKS {
                break;
            }
            continue;
        }
        let (theta_counts, alpha_counts) = plant.counts();
        let output = tick.decide(&TickInput {
            deadline_ns: u64::from(number) * 10_000_000,
            measurement: Some(Measurement {
                device_time_us: u64::from(number) * 10_000,
                theta_counts,
                alpha_counts,
                current_a: plant.current_a(),
                tachometer_counts_s: (plant.state.theta_dot / RAD_PER_COUNT) as i32,
                status: Status { armed: true, ..Status::default() },
                applied_mv,
                ..Measurement::default()
            }),
            ..TickInput::default()
        });
        episode.largest_mv = episode.largest_mv.max(output.voltage_mv.saturating_abs());
        episode.ending = output.ending;
        episode.last_tick = number;
        let jitter = 1.0 - share(10) * random.random::<f64>();
        let delay_s = domain.longest_delay_s * share(9) * jitter;
        // The wire keeps the order of its frames.
        sent_at_s = sent_at_s.max(now_s + delay_s);
        let voltage_mv = if output.ending.is_some() { 0 } else { output.voltage_mv };
        acts.push_back((sent_at_s, voltage_mv));
    }
    (episode.farthest_rad, episode.farthest_at_s) = (plant.farthest_rad, plant.farthest_at_s);
    episode
}
