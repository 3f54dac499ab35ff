use qube_hil::qube::{CONTROL_PERIOD_NS, State};

use super::genes::Genes;

/// A disturbance by the link or the computer.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MishapKind {
    /// No disturbance.
    Clean,
    /// Up to three samples in a row are lost.
    Lost,
    /// Up to three samples in a row are lost, twice, with good samples in between.
    LostTwice,
    /// One act comes up to 20 ms late.
    Stalled,
    /// Samples are lost, and at an independent time an act comes late.
    LostAndStalled,
    /// A stop is requested.
    StopAsked,
    /// Samples stop for good, and the device's watchdog switches the amplifier off.
    LinkDead,
}

impl MishapKind {
    /// Returns whether foresight promises to hold the arm under this mishap: at most three
    /// consecutive samples are lost, and no act is late in addition.
    pub fn is_promised(self) -> bool {
        !matches!(self, Self::LinkDead | Self::LostAndStalled)
    }
}

/// Onset of a mishap.
#[derive(Clone, Copy, Debug)]
enum Instant {
    /// After this many steps of the policy.
    Step(u32),
    /// The first tick after the policy's first step at which the arm's angle, extrapolated by 50 ms
    /// at its velocity, is farther than this from the middle, rad; also while the arm brakes.
    Outward(f64),
    /// This many ticks after the brake's second tick.
    Brake(u32),
}

/// An onset, and the ticks since then; `None` before it.
#[derive(Clone, Copy, Debug)]
struct Since {
    instant: Instant,
    ticks: Option<u32>,
}

/// The mishaps of an episode, tick by tick.
#[derive(Clone, Copy, Debug)]
pub struct Mishap {
    kind: MishapKind,
    loss: Since,
    /// Number of samples that are lost in a row.
    lost: u32,
    /// Number of good samples between two such losses.
    pause: u32,
    stall: Since,
    stall_ns: u64,
}

/// The circumstances at the beginning of a tick, which decide whether a mishap begins.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// Steps of the policy so far; `None` if there are none.
    pub step: Option<u32>,
    /// Ticks since the brake's second tick; `None` before it.
    pub brake: Option<u32>,
    /// The true state.
    pub state: State,
}

/// The mishaps of a tick.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct TickMishaps {
    pub lost: bool,
    pub dead: bool,
    pub stop: bool,
    pub stall_ns: u64,
}

impl Since {
    fn of(genes: &mut Genes, steps: u32) -> Self {
        let choice = genes.normal();
        let (step, outward, brake) =
            (genes.whole(1, steps), 0.5 + 2.5 * genes.unit(), genes.whole(0, 20));
        let instant = match choice {
            number if number < -0.4 => Instant::Step(step),
            number if number < 0.4 => Instant::Outward(outward),
            _ => Instant::Brake(brake),
        };
        Self { instant, ticks: None }
    }

    /// Counts one more tick; returns the ticks since the onset.
    fn tick(&mut self, moment: &Moment) -> Option<u32> {
        let State { theta, theta_dot, .. } = moment.state;
        let begins = match self.instant {
            Instant::Step(step) => moment.step.is_some_and(|now| now >= step),
            Instant::Outward(outward) => {
                moment.step.is_some() && (theta + 0.05 * theta_dot).abs() > outward
            }
            Instant::Brake(ticks) => moment.brake.is_some_and(|now| now >= ticks),
        };
        self.ticks = match self.ticks {
            Some(ticks) => Some(ticks + 1),
            None => begins.then_some(0),
        };
        self.ticks
    }
}

impl Mishap {
    /// Reads a mishap of this kind from the genes.
    pub fn new(kind: MishapKind, genes: &mut Genes, steps: u32) -> Self {
        Self {
            kind,
            loss: Since::of(genes, steps),
            lost: genes.whole(1, 3),
            pause: genes.whole(1, 12),
            stall: Since::of(genes, steps),
            stall_ns: (genes.unit() * 2.0 * CONTROL_PERIOD_NS as f64) as u64,
        }
    }

    /// The mishap of the tick that begins.
    pub fn tick(&mut self, moment: &Moment) -> TickMishaps {
        let (loss, stall) = (self.loss.tick(moment), self.stall.tick(moment));
        let burst = loss.is_some_and(|ticks| ticks < self.lost);
        let again = self.lost + self.pause;
        let second = loss.is_some_and(|ticks| (again..again + self.lost).contains(&ticks));
        let stall_ns = if stall == Some(0) { self.stall_ns } else { 0 };
        let none = TickMishaps::default();
        match self.kind {
            MishapKind::Clean => none,
            MishapKind::Lost => TickMishaps { lost: burst, ..none },
            MishapKind::LostTwice => TickMishaps { lost: burst || second, ..none },
            MishapKind::Stalled => TickMishaps { stall_ns, ..none },
            MishapKind::LostAndStalled => TickMishaps { lost: burst, stall_ns, ..none },
            MishapKind::StopAsked => TickMishaps { stop: loss.is_some(), ..none },
            MishapKind::LinkDead => {
                TickMishaps { lost: loss.is_some(), dead: loss.is_some(), ..none }
            }
        }
    }
}
