//! Tests that a healthy Qube whose arm stays away from its stops raises no fault, except for an
//! overheated motor or a brake that times out, under a policy that uses only full voltage. The
//! guard is the box without foresight, so that the policy runs as long as possible.

use std::collections::BTreeMap;
use std::sync::atomic::AtomicBool;

use qube_hil::clock::{Clock, VirtualClock};
use qube_hil::control::{
    ControlState, Homing, HomingSettings, Motion, Tick, TickInput, TickOutput, drive,
};
use qube_hil::device::emulator::EmulatorSettings;
use qube_hil::device::{Device, SerialLink};
use qube_hil::policy::Controller;
use qube_hil::qube::{
    CONTROL_PERIOD_NS, CONTROL_PERIOD_S, DomainParameter, HARD_STOP_RAD, MAX_VOLTAGE_V, Profile,
    QubeModel, State,
};
use qube_hil::rig::RolloutPlan;
use qube_hil::safety::{MotorHeat, SafetyBox};
use qube_hil::telemetry::{Ending, Fault, TickRules, TickSettings};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Largest number of rollouts on one Qube.
const ROLLOUTS: u64 = 20;

/// Number of threads, each with Qubes of its own.
const THREADS: u64 = 2;

/// Ticks that a Qube must give on average: a thread may drive one Qube for each 1000 ticks that it
/// needs. A Qube usually gives 9000.
const LEAST_TICKS: u64 = 1_000;

/// Number of Qubes that a thread may drive in addition.
const SPARE_QUBES: u64 = 20;

/// Number of Qubes per accepted failed homing; usually fewer than 1 homing of 1000 fails.
const QUBES_PER_FAILED_HOMING: u64 = 100;

/// Longest delay from a command to the motor, s. The delays thus include one period, 10 ms, at
/// which an alternating voltage changes at the motor just when a sample is taken.
const SLOWEST_S: f64 = 16e-3;

/// Jitter of the delay, s.
const JITTER_S: f64 = 1e-3;

/// A policy of full voltage whose sign changes at random times or depends on the side of a plane in
/// state space.
#[derive(Debug)]
struct BangBang {
    rng: ChaCha8Rng,
    /// Normal of the plane: weights of theta, theta_dot, sin(alpha) and alpha_dot; `None` for a
    /// policy whose sign changes at random times.
    plane: Option<[f64; 4]>,
    /// Longest time between two random changes of the sign, ticks.
    longest: u32,
    /// Remaining ticks of the present sign.
    left: u32,
    sign: f64,
}

impl BangBang {
    fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut uniform = || 2.0 * rng.random::<f64>() - 1.0;
        let plane = [3.0 * uniform(), 0.3 * uniform(), 3.0 * uniform(), 0.3 * uniform()];
        let plane = (seed % 2 == 1).then_some(plane);
        let longest = [1, 2, 5, 20, 60][rng.random_range(0..5)];
        Self { rng, plane, longest, left: 0, sign: 1.0 }
    }
}

impl Controller for BangBang {
    fn voltage_v(&mut self, state: &State) -> f64 {
        if let Some([theta, theta_dot, pendulum, alpha_dot]) = self.plane {
            let side = theta * state.theta
                + theta_dot * state.theta_dot
                + pendulum * state.alpha.sin()
                + alpha_dot * state.alpha_dot;
            return MAX_VOLTAGE_V * side.signum();
        }
        if self.left == 0 {
            self.left = self.rng.random_range(1..=self.longest);
            self.sign = -self.sign;
        }
        self.left -= 1;
        MAX_VOLTAGE_V * self.sign
    }
}

/// A Qube whose parameters lie within 10 % of the name plate's, with up to 1.5 times the friction,
/// dead zones and cable of `lab`, and a delay of up to `SLOWEST_S`, without its jitter.
fn qube(seed: u64) -> EmulatorSettings {
    let lab = Profile::lab().model();
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut model = QubeModel {
        nonidealities: lab.scaled(1.5 * rng.random::<f64>()).nonidealities,
        ..QubeModel::NOMINAL
    };
    for parameter in DomainParameter::ALL.into_iter().filter(|it| *it != DomainParameter::Gravity) {
        let nominal = model.parameters.get(parameter);
        model.parameters.set(parameter, nominal * (0.9 + 0.2 * rng.random::<f64>()));
    }
    model.nonidealities.command_delay_s = SLOWEST_S * rng.random::<f64>();
    EmulatorSettings { model, seed, command_jitter_s: JITTER_S, ..EmulatorSettings::default() }
}

/// A rollout that records how far the arm may have been from its middle.
struct Noted<C: Controller> {
    tick: Tick<C>,
    /// Largest angle, extrapolated from each sample to the next one, rad.
    farthest_rad: f64,
}

impl<C: Controller> Motion for Noted<C> {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        let output = self.tick.decide(input);
        let State { theta, theta_dot, .. } = output.state;
        let next_rad = theta + theta_dot * CONTROL_PERIOD_S;
        self.farthest_rad = self.farthest_rad.max(theta.abs()).max(next_rad.abs());
        output
    }

    fn control_state(&self) -> ControlState {
        self.tick.control_state()
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.tick.device_mv(voltage_mv)
    }
}

/// Counts over rollouts: Qubes, ticks, and the seeds of the Qubes by the fault that ended a rollout
/// on them.
#[derive(Debug, Default)]
struct Counted {
    qubes: u64,
    ticks: u64,
    not_homed: Vec<u64>,
    /// Faults before which the arm had hit no stop, except for those that `drive_qube` leaves out.
    faults: BTreeMap<String, Vec<u64>>,
    /// Faults after the arm may have hit a stop, which is possible without foresight.
    after_a_hit: BTreeMap<String, Vec<u64>>,
    /// Seeds of the Qubes whose arm the brake of the box did not slow down in time.
    brakes_timed_out: Vec<u64>,
}

impl Counted {
    fn and(mut self, other: Self) -> Self {
        self.qubes += other.qubes;
        self.ticks += other.ticks;
        self.not_homed.extend(other.not_homed);
        self.brakes_timed_out.extend(other.brakes_timed_out);
        for (all, more) in
            [(&mut self.faults, other.faults), (&mut self.after_a_hit, other.after_a_hit)]
        {
            for (fault, seeds) in more {
                all.entry(fault).or_default().extend(seeds);
            }
        }
        self
    }
}

/// Homes a Qube and drives it until a fault, for at most `ROLLOUTS` rollouts. An overheated motor
/// is not counted as a fault, and a brake that timed out is counted apart.
fn drive_qube(seed: u64, rules: TickRules) -> Counted {
    let clock = VirtualClock::default();
    let mut device = SerialLink::in_process(qube(seed), clock.clone());
    device.hello().expect("an emulated Qube answers");
    let stop = AtomicBool::new(false);
    let mut homing = Homing::new(&HomingSettings::default());
    let homed = drive(&mut device, &clock, &mut homing, &mut MotorHeat::default(), None, &stop)
        .expect("an armed board");
    if homed.outcome.ending != Ending::Completed {
        return Counted { qubes: 1, not_homed: vec![seed], ..Counted::default() };
    }
    let settings = TickSettings {
        calibration: homing.measured().expect("a homed Qube").calibration,
        safety_box: SafetyBox::THESIS,
        start_theta_rad: 0.0,
        rules,
        ..RolloutPlan::single("bang-bang", "full voltage").header().settings
    };
    let mut counted = Counted { qubes: 1, ..Counted::default() };
    for rollout in 0..ROLLOUTS {
        let begin_ns = clock.now_ns();
        let tick = Tick::new(&settings, BangBang::new(ROLLOUTS * seed + rollout));
        let mut noted = Noted { tick, farthest_rad: 0.0 };
        let report = drive(&mut device, &clock, &mut noted, &mut MotorHeat::default(), None, &stop)
            .expect("an armed board");
        counted.ticks += (clock.now_ns() - begin_ns) / CONTROL_PERIOD_NS;
        let Ending::Fault(fault) = report.outcome.ending else { continue };
        match fault {
            // A motor that full voltage has heated has to cool down.
            Fault::MotorOverheated => {}
            Fault::BrakingTimedOut => counted.brakes_timed_out.push(seed),
            _ => {
                let hit = noted.farthest_rad > HARD_STOP_RAD - 0.02;
                let faults = if hit { &mut counted.after_a_hit } else { &mut counted.faults };
                faults.entry(format!("{fault:?}")).or_default().push(seed);
            }
        }
        // The next rollout would need a new homing.
        break;
    }
    counted
}

/// Drives Qubes for at least this many ticks in all; checks that `Counted::faults` stays empty and
/// that hardly a homing fails. Each thread drives one Qube after the other; the seeds of a thread,
/// from `first_seed` on, do not depend on the other thread.
fn no_fault(first_seed: u64, wanted_ticks: u64) {
    let own_ticks = wanted_ticks.div_ceil(THREADS);
    let most_qubes = SPARE_QUBES + own_ticks / LEAST_TICKS;
    let work = |thread: u64| {
        let mut all = Counted::default();
        while all.ticks < own_ticks && all.qubes < most_qubes {
            let seed = first_seed + thread + THREADS * all.qubes;
            all = all.and(drive_qube(seed, TickRules::NEWEST));
        }
        all
    };
    let counted = std::thread::scope(|scope| {
        let threads: Vec<_> =
            (0..THREADS).map(|thread| scope.spawn(move || work(thread))).collect();
        let counted = threads.into_iter().map(|thread| thread.join().expect("a thread panicked"));
        counted.fold(Counted::default(), Counted::and)
    });
    println!("on {} Qubes, by seed: {counted:?}", counted.qubes);
    assert!(counted.ticks >= wanted_ticks && counted.faults.is_empty(), "{counted:?}");
    let most_failed_homings = 1 + counted.qubes / QUBES_PER_FAILED_HOMING;
    assert!(counted.not_homed.len() as u64 <= most_failed_homings, "{counted:?}");
}

#[test]
fn alternating_full_voltage_raises_no_fault() {
    no_fault(0, 30_000);
}

#[test]
fn a_slow_motor_raises_doubts_under_earlier_rules_only() {
    for (seed, fault) in [(1031, "EncoderFrozen"), (1194, "SettlingTimedOut")] {
        let earlier = drive_qube(seed, TickRules::FaultsFirst);
        assert!(earlier.faults.contains_key(fault), "{seed}: {earlier:?}");
        let newest = drive_qube(seed, TickRules::NEWEST);
        assert!(newest.faults.is_empty(), "{seed}: {newest:?}");
    }
}

#[test]
#[ignore = "takes minutes: scripts/adversary runs it"]
fn ten_million_ticks_of_full_voltage_raise_no_fault() {
    no_fault(1000, 10_000_000);
}
