use super::motion::{PackedMotion, simulated};
use super::nearest::{Nearest, guard_approach, nearest_approaches};
use super::page::{Cell, Page};
use crate::recording::{Completeness, Recording};
use crate::replay::{AngleError, GuardApproach, SimulatedSpecimen, SimulationError};
use crate::scoring::{Behaviour, Quietness, QuietnessFigures, Verdict, score_recording};
use crate::telemetry::{Ending, RolloutHeader, RolloutOutcome};

/// The figures and words of a rollout in a report. The recording itself is not kept.
#[derive(Clone, Debug, PartialEq)]
pub struct RolloutView {
    /// Header of the rollout's recording.
    pub header: RolloutHeader,
    /// Outcome of the rollout; `None` if the recording was truncated before it.
    pub outcome: Option<RolloutOutcome>,
    /// Verdict on the rollout.
    pub verdict: Verdict,
    /// Behaviour of the pendulum; `None` if the rollout has no result.
    pub behaviour: Option<Behaviour>,
    /// Quietness of the balancing; `None` if the pendulum never balanced.
    pub quietness: Option<QuietnessFigures>,
    /// Nearest approaches to the limits of the safety box.
    pub nearest: Vec<Nearest>,
    /// The tick at which the guard was nearest to ending the policy, and its time from the policy's
    /// first tick, s; `None` if it is unknown.
    pub guard: Option<(GuardApproach, f64)>,
    /// Name of the specimen that is simulated with the rollout's voltages.
    pub simulated: String,
    /// Error of this simulation; `None` if the simulation diverged, or if there was no motion or a
    /// long interruption in it.
    pub simulation_error: Option<SimulationError>,
    /// Motion for the player, not yet named.
    pub motion: PackedMotion,
    /// Defect of the file, if any.
    pub defect: Option<String>,
}

impl RolloutView {
    /// The view of a recording, with the simulation of this specimen under its voltages.
    #[must_use]
    pub fn of(recording: &Recording, specimen: &SimulatedSpecimen) -> Self {
        let nearest = nearest_approaches(recording);
        let guard = guard_approach(recording);
        let simulated = simulated(recording, &specimen.model);
        let beside = simulated.as_ref().map(|(log, open_loop)| (log, open_loop));
        Self {
            header: recording.header.clone(),
            outcome: recording.outcome.clone(),
            verdict: score_recording(recording),
            behaviour: Behaviour::of(recording),
            quietness: Quietness::of(&recording.ticks, &recording.header.settings.plant).figures(),
            motion: PackedMotion::of(recording, beside, &nearest).with_guard(guard),
            simulated: specimen.name.clone(),
            simulation_error: beside.map(|(log, open_loop)| SimulationError::of(log, open_loop)),
            nearest,
            guard,
            defect: match (recording.loss(), &recording.completeness) {
                (Some(loss), _) => Some(format!("the recording {loss}")),
                (None, Completeness::Recovered) => {
                    Some("the recording was recovered after it had been cut off".into())
                }
                (None, _) => None,
            },
        }
    }

    /// The result in a few words: return and behaviour, or why there is no result.
    #[must_use]
    pub fn result(&self) -> String {
        match (&self.verdict, self.behaviour) {
            (Verdict::Result { return_, .. }, Some(behaviour)) => {
                format!("return {return_:.1}, {}", self.behaviour_words(behaviour))
            }
            (Verdict::Result { return_, .. }, None) => format!("return {return_:.1}"),
            (Verdict::Void { reason }, _) => format!("void: {reason}"),
            (Verdict::Unfinished, _) => "unfinished".into(),
        }
    }

    /// The behaviour in words, with the limit's own words for a rollout that a limit ended.
    fn behaviour_words(&self, behaviour: Behaviour) -> &'static str {
        match self.outcome.as_ref().map(|outcome| outcome.ending) {
            Some(Ending::LeftBox(limit)) => limit.in_brief(),
            _ => behaviour_words(behaviour),
        }
    }

    /// The nearest approach to a limit, of all limits of the box; `None` if the policy never drove
    /// the motor.
    #[must_use]
    pub fn nearest_of_all(&self) -> Option<&Nearest> {
        self.nearest.iter().max_by(|one, other| one.share.total_cmp(&other.share))
    }

    /// The text for the player, as far as it is known: result, ending, nearest approach to a limit,
    /// the guard's nearest approach to ending the policy, the error of the simulation, and a defect
    /// of the file.
    #[must_use]
    pub fn sentence(&self) -> String {
        let mut parts = vec![first_upper(&self.result())];
        if let Some(outcome) = &self.outcome {
            parts.push(ending_words(outcome));
        }
        if let Some(nearest) = self.nearest_of_all() {
            parts.push(format!(
                "Nearest to a limit: the {} with {:.2} {} at {:.2} s, {:.0} % of {:.2}",
                nearest.quantity,
                nearest.value,
                nearest.unit,
                nearest.time_s,
                100.0 * nearest.share,
                nearest.limit
            ));
        }
        parts.extend(self.guard.map(guard_words));
        if let Some(error) = self.simulation_error {
            parts.extend(simulation_sentences(&self.simulated, error));
        }
        parts.extend(self.defect.as_deref().map(first_upper));
        parts.join(". ") + "."
    }
}

/// The behaviour in words, as a head over the share of all rollouts with this behaviour.
#[must_use]
pub fn behaviour_words(behaviour: Behaviour) -> &'static str {
    match behaviour {
        Behaviour::Balanced => "success",
        Behaviour::BalancedLate => "balanced too late",
        Behaviour::LeftBox => "left the box or ended by the guard",
        Behaviour::Chattered => "chattered",
        Behaviour::Fell => "fell or never got up",
        Behaviour::Fault => "fault",
    }
}

/// Says which specimen was simulated and how far its motion is from the recorded one; sentences
/// without their full stops.
fn simulation_sentences(simulated: &str, error: SimulationError) -> Vec<String> {
    let rad = |AngleError { theta_rad, alpha_rad }: AngleError| {
        format!("{theta_rad:.2} rad in θ and {alpha_rad:.2} rad in α")
    };
    let before = error.until_upright.map_or_else(String::new, |before| {
        format!("{} until the pendulum is first upright, and ", rad(before))
    });
    let mut sentences = vec![format!(
        "The simulation is of {simulated}: it got the same voltages from the same start and nothing else, and its \
         root mean square error is {before}{} over the whole motion",
        rad(error.whole)
    )];
    if error.falls {
        sentences
            .push("Near upright a small error grows, so that the simulated pendulum falls".into());
    }
    sentences
}

/// Says how a rollout ended; a sentence without its full stop.
fn ending_words(outcome: &RolloutOutcome) -> String {
    match outcome.ending {
        Ending::Completed => format!("The policy took all {} steps", outcome.steps),
        Ending::LeftBox(limit) => {
            format!("It {limit}, after {} steps", outcome.steps)
        }
        Ending::Stopped => "Somebody stopped it".into(),
        Ending::Fault(fault) => format!("A fault ended it: {fault}"),
    }
}

/// Says where the guard was nearest to ending the policy; a sentence without its full stop.
fn guard_words((approach, time_s): (GuardApproach, f64)) -> String {
    let GuardApproach { theta_rad, foreseen, .. } = approach;
    let (largest_rad, end_rad) = (foreseen.largest_rad, foreseen.end_rad);
    let when = format!("at {time_s:.2} s, with θ at {theta_rad:.2} rad");
    if !largest_rad.is_finite() {
        return format!(
            "The guard was nearest {when}: it could not predict where the arm would stop"
        );
    }
    let predicted = format!(
        "for one of the Qubes that this one may be, it predicted that the policy's voltage and the brake after it \
         take the arm to {largest_rad:.2} rad"
    );
    if largest_rad >= end_rad {
        return format!(
            "The guard ended the policy {when}: {predicted}, and no arm may reach {end_rad:.2}"
        );
    }
    let share = 100.0 * largest_rad / end_rad;
    format!(
        "The guard was nearest {when}: {predicted}, {share:.0} % of the {end_rad:.2} that no arm may reach"
    )
}

/// Returns the text with a capital first letter.
pub fn first_upper(text: &str) -> String {
    let mut letters = text.chars();
    match letters.next() {
        Some(first) => first.to_uppercase().chain(letters).collect(),
        None => String::new(),
    }
}

/// Adds the player of these motions, which must be named, and instructions for it. If the motions
/// exceed [`MOTION_BYTES`], all are thinned, and some may be left out. `first` is the index of the
/// motion that is chosen at the start.
pub fn add_player(page: &mut Page, motions: Vec<PackedMotion>, first: usize) {
    let (motions, first, note) = within_budget(motions, first);
    page.paragraph(
        "Choose a rollout, play it, or drag the slider. In the figures: drag to zoom, double-click to see all \
         again, click to go to a time. Time counts from the policy's first tick.",
    );
    if let Some(note) = note {
        page.paragraph(&note);
    }
    page.player(motions, first);
}

/// Largest size of all motions in a page together, bytes, so that a page stays below 5 MB.
const MOTION_BYTES: usize = 3_200_000;

/// Strides by which motions are thinned: every tick, or every second, fourth or tenth. The first
/// that suffices is used, or else the last.
const STRIDES: [usize; 4] = [1, 2, 4, 10];

/// The motions that fit into a page, the index of the chosen one among them, and, if the motions
/// were thinned, a note for the reader. Motions are thinned only as far as necessary. Motions that
/// do not fit even then are left out, except the chosen one, and the note says how many.
fn within_budget(
    motions: Vec<PackedMotion>,
    first: usize,
) -> (Vec<PackedMotion>, usize, Option<String>) {
    let bytes: usize = motions.iter().map(PackedMotion::bytes).sum();
    let stride = STRIDES.into_iter().find(|stride| bytes / stride <= MOTION_BYTES).unwrap_or(10);
    if stride == 1 {
        return (motions, first, None);
    }
    let all = motions.len();
    let mut kept = Vec::new();
    let (mut used, mut kept_first) = (0, 0);
    for (index, motion) in motions.into_iter().enumerate() {
        let motion = motion.every(stride);
        let is_first = index == first;
        if used + motion.bytes() > MOTION_BYTES && !is_first {
            continue;
        }
        used += motion.bytes();
        if is_first {
            kept_first = kept.len();
        }
        kept.push(motion);
    }
    let left_out = match all - kept.len() {
        0 => String::new(),
        count => format!(
            " {count} of {all} rollouts are left out; a report on their recordings shows them."
        ),
    };
    let note = format!("To keep this page small, one tick in {stride} is shown.{left_out}");
    (kept, kept_first, Some(note))
}

/// The heads of the columns of a table of rollouts, after the columns that name the rollout.
pub const ROLLOUT_HEADS: [&str; 8] = [
    "result",
    "return",
    "nearest to a limit",
    "voltage change, V a tick",
    "sign changes a second",
    "copper loss, W",
    "motor load, %",
    "missed deadlines",
];

/// The cells of a rollout in the columns [`ROLLOUT_HEADS`].
#[must_use]
pub fn rollout_cells(view: &RolloutView) -> Vec<Cell> {
    let result = match (&view.verdict, view.behaviour) {
        (Verdict::Result { .. }, Some(behaviour)) => view.behaviour_words(behaviour).to_owned(),
        _ => view.result(),
    };
    let nearest = view
        .nearest_of_all()
        .map_or("–".into(), |it| format!("{:.0} %, {}", 100.0 * it.share, it.quantity));
    let figure = |of: fn(&QuietnessFigures) -> f64| view.quietness.as_ref().map(of);
    let load = view.outcome.as_ref().and_then(|outcome| outcome.largest_motor_load);
    let missed = view.outcome.as_ref().map(|outcome| f64::from(outcome.missed_deadlines));
    vec![
        result.into(),
        Cell::number(view.verdict.return_(), 1),
        nearest.into(),
        Cell::number(figure(|it| it.change_v), 2),
        Cell::number(figure(|it| it.sign_changes_per_s), 1),
        Cell::number(figure(|it| it.copper_loss_w), 2),
        Cell::number(load.map(|load| 100.0 * load), 0),
        Cell::number(missed, 0),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::samples;
    use crate::safety::Limit;
    use crate::telemetry::{Phase, TickRecord};

    fn motion(ticks: u32) -> PackedMotion {
        let tick = |tick| TickRecord { tick, phase: Phase::Running, ..TickRecord::default() };
        let recording = Recording {
            header: samples::header(),
            policy: Vec::new(),
            ticks: (0..ticks).map(tick).collect(),
            outcome: None,
            completeness: Completeness::Whole,
        };
        PackedMotion::of(&recording, None, &[])
    }

    #[test]
    fn a_rollout_that_left_the_box_is_not_called_ended_by_the_guard() {
        let ended = |limit| {
            let outcome = RolloutOutcome { ending: Ending::LeftBox(limit), ..samples::outcome() };
            let mut recording = Recording {
                header: samples::header(),
                policy: Vec::new(),
                ticks: (0..40).map(samples::tick).collect(),
                outcome: Some(outcome),
                completeness: Completeness::Whole,
            };
            recording.header.settings.safety_box.alpha = 1e3;
            let plant = recording.header.settings.plant;
            RolloutView::of(&recording, &SimulatedSpecimen::nominal(&plant))
        };
        for (limit, words) in [
            (Limit::Alpha, "left the box"),
            (Limit::Foresight, "ended by the guard"),
            (Limit::Unpredicted, "ended by the guard"),
            (Limit::MotorLoad, "ended by the motor's load"),
        ] {
            let view = ended(limit);
            assert!(view.result().ends_with(&format!(", {words}")), "{}", view.result());
            assert_eq!(rollout_cells(&view)[0], words.into());
            assert!(view.sentence().contains(&format!(". It {limit}, after")));
            assert!(view.sentence().contains("The simulation is of the nominal Qube: it got"));
        }
        assert_eq!(behaviour_words(Behaviour::LeftBox), "left the box or ended by the guard");
    }

    #[test]
    fn many_rollouts_are_thinned_then_left_out_and_the_page_says_so() {
        let (kept, first, note) = within_budget(vec![motion(800); 10], 9);
        assert_eq!((kept.len(), first, note), (10, 9, None));
        let (kept, first, note) = within_budget(vec![motion(800); 800], 700);
        assert_eq!((kept.len(), first), (800, 700));
        assert!(note.unwrap().contains("one tick in 2 is"));
        let (kept, first, note) = within_budget(vec![motion(30_000); 300], 299);
        let bytes: usize = kept.iter().map(PackedMotion::bytes).sum();
        assert!(bytes <= MOTION_BYTES + motion(3_000).bytes(), "{bytes}");
        assert_eq!(first, kept.len() - 1);
        assert!(note.unwrap().contains("left out"));
    }
}
