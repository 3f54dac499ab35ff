use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};

use qube_hil::clock::{Clock, Nanoseconds, VirtualClock};
use qube_hil::control::{ControlState, Motion, TickInput, TickOutput};
use qube_hil::device::{Device, DeviceError, Identity, LinkFault};
use qube_hil::qube::{Measurement, RAD_PER_COUNT, Status, counts};
use qube_hil::telemetry::Phase;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::mishap::{Mishap, Moment, TickMishaps};
use super::plant::Plant;

/// Time after arming or the last accepted act at which the device switches its amplifier off, ns.
const WATCHDOG_NS: u64 = 50_000_000;

/// Largest age of the sample that an act may answer, us.
const STALE_US: u64 = 20_000;

/// Shortest time between two samples, ns: each takes this long on the wire.
const ANSWER_NS: u64 = 100_000;

/// Time since a rollout began after which it is stopped if it still settles, ns: only attacks are
/// of interest.
const PATIENCE_NS: u64 = 9_000_000_000;

/// Progress of the motion, which [`Watched`] reports.
#[derive(Clone, Debug, Default)]
pub struct MotionProgress {
    steps: Arc<AtomicU32>,
    brakes: Arc<AtomicU32>,
}

/// A motion that reports its progress.
pub struct Watched<M> {
    pub motion: M,
    pub progress: MotionProgress,
}

impl MotionProgress {
    /// Resets the counts.
    pub fn start(&self) {
        self.steps.store(0, Ordering::Relaxed);
        self.brakes.store(0, Ordering::Relaxed);
    }

    /// Number of braking ticks so far.
    pub fn brakes(&self) -> u32 {
        self.brakes.load(Ordering::Relaxed)
    }

    /// Number of the policy's steps so far.
    pub fn steps(&self) -> u32 {
        self.steps.load(Ordering::Relaxed)
    }
}

impl<M: Motion> Motion for Watched<M> {
    fn decide(&mut self, input: &TickInput) -> TickOutput {
        let output = self.motion.decide(input);
        match output.phase {
            Phase::Settling => {}
            Phase::Running => _ = self.progress.steps.fetch_add(1, Ordering::Relaxed),
            Phase::Braking => _ = self.progress.brakes.fetch_add(1, Ordering::Relaxed),
        }
        output
    }

    fn control_state(&self) -> ControlState {
        self.motion.control_state()
    }

    fn device_mv(&self, voltage_mv: i16) -> i16 {
        self.motion.device_mv(voltage_mv)
    }
}

/// Part of an episode.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Part {
    Settling,
    Running,
    Braking,
    Coasting,
    /// Coasting, where the cable alone pulled the arm to its stop: foresight does not promise to
    /// hold an arm against its cable with the amplifier off.
    Pulled,
}

/// A healthy Qube behind a link with mishaps.
pub struct Qube {
    pub plant: Plant,
    pub clock: VirtualClock,
    pub mishap: Mishap,
    pub progress: MotionProgress,
    pub stop: Arc<AtomicBool>,
    /// Time at which the present rollout began, ns.
    pub rollout_began_ns: u64,
    /// Error of the arm's zero, rad.
    pub zero_rad: f64,
    /// Random numbers and the largest delay of a sample, ns; `None` without jitter.
    pub jitter: Option<(ChaCha8Rng, u64)>,
    /// True if a mishap happened before the arm reached its stop.
    pub went_wrong: bool,
    /// Part of the episode in which the arm first reached its stop.
    pub hit_in: Option<Part>,
    /// A line for each tick, if requested.
    pub lines: Option<Vec<String>>,
    armed: bool,
    /// This Qube without its cable, simulated since the amplifier was last switched off.
    free: Option<Plant>,
    tripped: bool,
    dead: bool,
    fed_ns: u64,
    sampled_ns: Option<u64>,
    applied_mv: i16,
    wrong: TickMishaps,
}

impl Qube {
    /// A Qube that is not armed.
    pub fn new(plant: Plant, mishap: Mishap, zero_rad: f64) -> Self {
        Self {
            plant,
            clock: VirtualClock::default(),
            mishap,
            progress: MotionProgress::default(),
            stop: Arc::default(),
            rollout_began_ns: 0,
            zero_rad,
            jitter: None,
            hit_in: None,
            went_wrong: false,
            lines: None,
            armed: false,
            free: None,
            tripped: false,
            dead: false,
            fed_ns: 0,
            sampled_ns: None,
            applied_mv: 0,
            wrong: TickMishaps::default(),
        }
    }

    /// Lets the arm coast for this time, or until arm and pendulum are at rest with the amplifier
    /// off. The device gets no requests.
    pub fn coast(&mut self, duration_ns: u64) {
        let until_ns = self.plant.now_ns + duration_ns;
        while self.plant.now_ns < until_ns {
            self.clock.sleep_until((self.plant.now_ns + 10_000_000).min(until_ns));
            self.catch_up();
            if !self.armed && self.plant.is_at_rest() {
                break;
            }
        }
    }

    fn catch_up(&mut self) {
        let now_ns = self.clock.now_ns();
        if self.armed && now_ns >= self.fed_ns + WATCHDOG_NS {
            self.plant.go_on_until(self.fed_ns + WATCHDOG_NS);
            self.tripped = true;
            self.switch_off();
        }
        self.plant.go_on_until(now_ns);
        if self.plant.hit_rad_s.is_some() && self.hit_in.is_none() {
            self.hit_in = Some(self.part());
        }
    }

    fn part(&mut self) -> Part {
        match (self.armed, self.progress.steps(), self.progress.brakes()) {
            (false, ..) => match &mut self.free {
                Some(free) => {
                    free.go_on_until(self.plant.now_ns);
                    if free.hit_rad_s.is_none() { Part::Pulled } else { Part::Coasting }
                }
                None => Part::Coasting,
            },
            (true, 0, 0) => Part::Settling,
            (true, _, 0) => Part::Running,
            (true, ..) => Part::Braking,
        }
    }

    fn switch_off(&mut self) {
        self.armed = false;
        self.applied_mv = 0;
        self.plant.command(0.0);
        self.free = Some(self.plant.without_cable());
    }

    fn moment(&self) -> Moment {
        let begun = |ticks: u32| (ticks > 0).then_some(ticks);
        Moment {
            step: begun(self.progress.steps()),
            brake: begun(self.progress.brakes()).map(|ticks| ticks - 1),
            state: self.plant.state,
        }
    }

    fn note(&mut self) {
        if let Some(lines) = &mut self.lines {
            let (state, wrong) = (&self.plant.state, &self.wrong);
            lines.push(format!(
                "{:7.1} ms  step {:3} brake {:3}  theta {:+.3} {:+6.2}  alpha {:+.3} {:+6.2}  \
                 sent {:+.2} V{}{}",
                self.plant.now_ns as f64 * 1e-6,
                self.progress.steps(),
                self.progress.brakes(),
                state.theta,
                state.theta_dot,
                state.alpha,
                state.alpha_dot,
                f64::from(self.applied_mv) * 1e-3,
                if wrong.lost { "  lost" } else { "" },
                if wrong.stall_ns > 0 {
                    format!("  stalls {} us", wrong.stall_ns / 1000)
                } else {
                    String::new()
                },
            ));
        }
    }
}

impl Device for Qube {
    fn hello(&mut self) -> Result<Identity, DeviceError> {
        Err(DeviceError::Link { port: "none".into(), fault: LinkFault::Gone })
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.catch_up();
        (self.armed, self.tripped, self.fed_ns) = (true, false, self.clock.now_ns());
        Ok(())
    }

    fn sample(&mut self, deadline_ns: Nanoseconds) -> Result<Measurement, LinkFault> {
        if let Some((random, most_ns)) = &mut self.jitter {
            self.clock.advance(random.random_range(0..=*most_ns));
        }
        if let Some(sampled_ns) = self.sampled_ns {
            self.clock.sleep_until(sampled_ns + ANSWER_NS);
        }
        self.sampled_ns = Some(self.clock.now_ns());
        self.catch_up();
        self.wrong = self.mishap.tick(&self.moment());
        self.dead |= self.wrong.dead;
        self.went_wrong |= self.wrong != TickMishaps::default() && self.hit_in.is_none();
        let settles_for_ever =
            self.progress.steps() == 0 && self.plant.now_ns > self.rollout_began_ns + PATIENCE_NS;
        if self.wrong.stop || settles_for_ever {
            self.stop.store(true, Ordering::Relaxed);
        }
        self.note();
        if self.wrong.lost {
            self.clock.sleep_until(deadline_ns);
            return Err(LinkFault::Timeout);
        }
        let state = &self.plant.state;
        Ok(Measurement {
            device_time_us: self.plant.now_ns / 1000,
            theta_counts: counts(state.theta + self.zero_rad),
            alpha_counts: counts(state.alpha),
            status: Status {
                armed: self.armed,
                watchdog_tripped: self.tripped,
                ..Status::default()
            },
            tachometer_counts_s: (state.theta_dot / RAD_PER_COUNT) as i32,
            applied_mv: self.applied_mv,
            current_a: self.plant.current_a() as f32,
            ..Measurement::default()
        })
    }

    fn act(&mut self, voltage_mv: i16, sampled_at_us: u64) -> Result<(), LinkFault> {
        self.clock.advance(self.wrong.stall_ns);
        self.catch_up();
        let age_us = (self.clock.now_ns() / 1000).saturating_sub(sampled_at_us);
        if self.armed && age_us <= STALE_US {
            self.fed_ns = self.clock.now_ns();
            self.applied_mv = voltage_mv;
            self.plant.command(f64::from(voltage_mv) * 1e-3);
        }
        Ok(())
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.catch_up();
        if self.dead {
            return Err(DeviceError::Link { port: "none".into(), fault: LinkFault::Timeout });
        }
        self.switch_off();
        Ok(())
    }

    fn is_hardware(&self) -> bool {
        false
    }
}
