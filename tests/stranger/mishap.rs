use qube_hil::qube::{CONTROL_PERIOD_NS, State};

use super::genes::Genes;

/// What the link or the computer does beside the policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MishapKind {
    /// Nothing.
    Clean,
    /// Up to three samples in a row are lost.
    Lost,
    /// The same twice, with good samples between.
    LostTwice,
    /// One act comes up to 20 ms late.
    Stalled,
    /// Samples are lost, and elsewhere an act comes late.
    LostAndStalled,
    /// Somebody asks to stop.
    StopAsked,
    /// No sample comes any more: the device's watchdog switches off.
    LinkDead,
}

impl MishapKind {
    /// Whether the guard can still brake: no more than three samples are lost in a row, and no act is late
    /// beside them.
    pub fn is_promised(self) -> bool {
        !matches!(self, Self::LinkDead | Self::LostAndStalled)
    }
}

/// At which instant a mishap begins.
#[derive(Clone, Copy, Debug)]
enum Instant {
    /// In this step of the policy.
    Step(u32),
    /// When the arm first comes this far out, its velocity over 50 ms counted in, rad.
    Outward(f64),
    /// So many ticks after the brake began.
    Brake(u32),
}

/// An instant, and the ticks since then.
#[derive(Clone, Copy, Debug)]
struct Since {
    instant: Instant,
    ticks: Option<u32>,
}

/// What goes wrong in an episode, tick by tick.
#[derive(Clone, Copy, Debug)]
pub struct Mishap {
    kind: MishapKind,
    loss: Since,
    lost: u32,
    pause: u32,
    stall: Since,
    stall_ns: u64,
}

/// What a tick knows when it begins.
#[derive(Clone, Copy, Debug)]
pub struct Moment {
    /// Steps of the policy so far; none before its first.
    pub step: Option<u32>,
    /// Ticks of the brake so far; none before its first.
    pub brake: Option<u32>,
    /// The true state.
    pub state: State,
}

/// What goes wrong in a tick.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Wrong {
    pub lost: bool,
    pub dead: bool,
    pub stop: bool,
    pub stall_ns: u64,
}

impl Since {
    fn of(genes: &mut Genes, steps: u32) -> Self {
        let which = genes.normal();
        let (step, outward, brake) =
            (genes.whole(1, steps), 0.5 + 2.5 * genes.unit(), genes.whole(0, 20));
        let instant = match which {
            it if it < -0.4 => Instant::Step(step),
            it if it < 0.4 => Instant::Outward(outward),
            _ => Instant::Brake(brake),
        };
        Self { instant, ticks: None }
    }

    /// Counts one more tick; how many there were since the instant.
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
    /// What the genes say of this kind.
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

    /// What goes wrong in the tick that begins.
    pub fn tick(&mut self, moment: &Moment) -> Wrong {
        let (loss, stall) = (self.loss.tick(moment), self.stall.tick(moment));
        let burst = loss.is_some_and(|ticks| ticks < self.lost);
        let again = self.lost + self.pause;
        let second = loss.is_some_and(|ticks| (again..again + self.lost).contains(&ticks));
        let stall_ns = if stall == Some(0) { self.stall_ns } else { 0 };
        let none = Wrong::default();
        match self.kind {
            MishapKind::Clean => none,
            MishapKind::Lost => Wrong { lost: burst, ..none },
            MishapKind::LostTwice => Wrong { lost: burst || second, ..none },
            MishapKind::Stalled => Wrong { stall_ns, ..none },
            MishapKind::LostAndStalled => Wrong { lost: burst, stall_ns, ..none },
            MishapKind::StopAsked => Wrong { stop: loss.is_some(), ..none },
            MishapKind::LinkDead => Wrong { lost: loss.is_some(), dead: loss.is_some(), ..none },
        }
    }
}
