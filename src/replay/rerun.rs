use crate::control::{DeviceLoss, Motion, Tick, TickInput};
use crate::policy::{Controller, Policy, PolicyFault};
use crate::recording::Recording;
use crate::safety::{Contradiction, Foreseen, ForeseenAngle, Guard};
use crate::scoring::return_of;
use crate::telemetry::{Ending, Phase, TickRecord};

/// The result of a replay: the recorded decisions compared with the recomputed ones.
#[derive(Clone, Debug, PartialEq)]
pub struct Rerun {
    /// Return from the recorded states and voltages of all ticks of the file; at most 600 in a
    /// rollout of 600 steps.
    pub return_recorded: f64,
    /// Return from the recomputed states and voltages of the compared ticks.
    pub return_recomputed: f64,
    /// Number of ticks whose decision was compared.
    pub actions_compared: usize,
    /// Number of ticks whose recomputed decision differs: the voltage that was requested or sent,
    /// the phase, or the state.
    pub actions_different: usize,
    /// First tick whose recomputed decision differs.
    pub first_difference: Option<TickDifference>,
    /// Number of ticks that could not be compared because earlier ones are missing.
    pub not_compared: usize,
    /// Ending of the rollout: the recomputed one, or the recorded one where `ending_of_the_file` is
    /// set. `None` if the last compared tick does not end the rollout, for example because later
    /// ticks are missing.
    pub ending: Option<Ending>,
    /// Recomputed prediction for which foresight ended the rollout; `None` if foresight did not end
    /// it.
    pub foreseen: Option<Foreseen>,
    /// Recomputed contradiction of the profile by which the rollout ended; `None` if it did not.
    pub contradiction: Option<Contradiction>,
    /// Recomputed tick at which foresight was nearest to ending the policy; `None` if the guard was
    /// not foresight, or if no policy ran.
    pub guard_approach: Option<GuardApproach>,
    /// True if the rollout braked under [`Guard::Envelope`], a guard of old recordings that this
    /// program cannot compute: ticks from the first braking tick on are not compared, and the
    /// ending is the file's.
    pub ending_of_the_file: bool,
}

/// The tick at which foresight was nearest to ending the policy, or ended it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GuardApproach {
    /// Number of the tick.
    pub tick: u32,
    /// Angle of the arm in that tick, rad.
    pub theta_rad: f64,
    /// Angle that foresight predicted for the voltage of that tick and the brake after it.
    pub foreseen: ForeseenAngle,
}

/// One tick whose recomputed decision differs.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TickDifference {
    /// The tick as the file has it.
    pub recorded: TickRecord,
    /// The tick as it was recomputed.
    pub recomputed: TickRecord,
}

impl Rerun {
    /// Returns whether every tick that this program can compute was compared, and every decision
    /// and the return came out again, bit for bit.
    #[must_use]
    pub fn agrees(&self) -> bool {
        self.actions_different == 0
            && self.not_compared == 0
            && self.return_recorded.to_bits() == self.return_recomputed.to_bits()
    }
}

/// The controller that drove a recording: the policy attached to it, or, after an external
/// controller, a policy that repeats the recorded answers.
///
/// # Errors
/// The attachment is not a policy.
pub fn controller_of(recording: &Recording) -> Result<Policy, PolicyFault> {
    let external = match Policy::from_bytes(&recording.policy)? {
        Policy::External(external) => external,
        policy => return Ok(policy),
    };
    let running = recording.ticks.iter().filter(|tick| tick.phase == Phase::Running);
    // An answer that the guard refused is in no running tick: the guard replaces it, and the tick's
    // phase is then braking. The outcome holds that last answer.
    let last_v = recording.outcome.as_ref().and_then(|outcome| outcome.last_answer_v);
    let answers_v = running.filter_map(|tick| tick.wanted_v).chain(last_v);
    Ok(Policy::External(external.answering(answers_v.collect())))
}

/// Feeds the recorded measurements and times to the tick that ran on the machine, and compares its
/// decisions with the recorded ones. `policy` is the controller that drove the rollout;
/// [`controller_of`] gives it.
///
/// The comparison ends where ticks are missing, because the recorder had no room for them or a
/// block of the file is damaged: the state of the filters depends on every earlier tick. It also
/// ends where a rollout under [`Guard::Envelope`] brakes, because this program cannot compute that
/// guard and its brake.
#[must_use]
pub fn rerun(recording: &Recording, policy: impl Controller) -> Rerun {
    let mut tick = Tick::new(&recording.header.settings, policy);
    let outcome_ending = recording.outcome.as_ref().map(|outcome| outcome.ending);
    let ended_by = |loss: &DeviceLoss| outcome_ending == Some(Ending::Fault(loss.fault()));
    let loss_at_end = DeviceLoss::ALL.into_iter().find(ended_by);
    let knows_guard = recording.header.settings.safety_box.guard != Guard::Envelope;
    let is_known = |tick: &&TickRecord| knows_guard || tick.phase != Phase::Braking;
    let known = recording.ticks.iter().take_while(is_known).count();
    let ticks = &recording.ticks[..known];
    let ending_of_the_file = known < recording.ticks.len();
    let whole = ticks.iter().zip(0..).take_while(|(tick, number)| tick.tick == *number);
    let compared: Vec<&TickRecord> = whole.map(|(tick, _)| tick).collect();

    let mut heat = recording.header.motor_heat;
    let mut voltage_mv = 0;
    let mut recomputed = Vec::with_capacity(compared.len());
    let mut ending = None;
    let mut guard_approach: Option<GuardApproach> = None;
    for (index, recorded) in compared.iter().enumerate() {
        // A recording has no field for the loss of the device, but the outcome names it. The loss
        // ends the rollout, so it happens only in the last tick, which has no sample. The last tick
        // of a recording whose end is missing may be an earlier one.
        let may_be_the_end = index + 1 == recording.ticks.len() && recorded.measurement.is_none();
        let output = tick.decide(&TickInput {
            deadline_ns: recorded.deadline_ns,
            lateness_ns: recorded.lateness_ns,
            skipped_periods: recorded.skipped_periods,
            stop_requested: recorded.stop_requested,
            measurement: recorded.measurement,
            device_loss: loss_at_end.filter(|_| may_be_the_end),
            motor_overheated: heat.is_some_and(|heat| heat.is_overheated()),
        });
        if let Some(heat) = &mut heat {
            let measurement = recorded.measurement.as_ref();
            let theta_dot_rad_s = output.heating_theta_dot_rad_s;
            heat.pass(recorded.skipped_periods, measurement, voltage_mv, theta_dot_rad_s);
        }
        voltage_mv = output.voltage_mv;
        if let Some(foreseen) = tick.foreseen_angle()
            && guard_approach.is_none_or(|it| foreseen.largest_rad > it.foreseen.largest_rad)
        {
            let theta_rad = output.state.theta;
            guard_approach = Some(GuardApproach { tick: recorded.tick, theta_rad, foreseen });
        }
        recomputed.push(TickRecord {
            phase: output.phase,
            state: output.state,
            wanted_v: output.wanted_v,
            voltage_mv: output.voltage_mv,
            ..**recorded
        });
        ending = output.ending;
    }

    let differences: Vec<TickDifference> = compared
        .iter()
        .zip(&recomputed)
        .filter(|(recorded, recomputed)| !same_decision(recorded, recomputed))
        .map(|(recorded, recomputed)| TickDifference {
            recorded: **recorded,
            recomputed: *recomputed,
        })
        .collect();
    Rerun {
        return_recorded: return_of(&recording.ticks, &recording.header.reward),
        return_recomputed: return_of(&recomputed, &recording.header.reward),
        actions_compared: compared.len(),
        actions_different: differences.len(),
        first_difference: differences.first().copied(),
        not_compared: known - compared.len(),
        foreseen: tick.foreseen(),
        contradiction: tick.contradiction(),
        guard_approach,
        ending: if ending_of_the_file { outcome_ending } else { ending },
        ending_of_the_file,
    }
}

fn same_decision(recorded: &TickRecord, recomputed: &TickRecord) -> bool {
    let bits = |tick: &TickRecord| {
        let state = tick.state;
        let numbers = [state.theta, state.alpha, state.theta_dot, state.alpha_dot];
        (tick.phase, tick.voltage_mv, numbers.map(number_bits), tick.wanted_v.map(number_bits))
    };
    bits(recorded) == bits(recomputed)
}

/// The bits of a number, with one value for all NaN: the processor chooses which NaN an operation
/// gives, and no NaN is ever sent to the motor.
fn number_bits(number: f64) -> u64 {
    if number.is_nan() { f64::NAN.to_bits() } else { number.to_bits() }
}
