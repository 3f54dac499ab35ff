use super::evidence::{Evidence, Pendulum, PushEffect};
use super::examined_device::ExaminedDevice;
use super::rest::Window;
use super::{Examination, ExaminationSettings, Interruption, OtherSigns, rest};
use crate::control::{ProbeTrace, SignProbe, drive, fault_after};
use crate::device::LinkFault;
use crate::estimation::Calibration;
use crate::qube::PlantModel;
use crate::safety::MotorHeat;
use crate::telemetry::{CheckResult, Ending, Fault, Hint};

/// Increment of the push, V. Pushes alternate in direction, and an arm that the last push did not
/// move gets at most this much beyond its friction.
const STEP_V: f64 = 0.25;

/// Number of increments, which reach 2.75 V. A good arm moves at 0.11 V, and a stiff one is
/// reported to need 0.65 V; friction, a dead zone on one side and a cable together may need more
/// than 2 V.
const STEPS: u32 = 11;

/// Largest number of repetitions of a push that ended with a fault which points to no defect of the
/// Qube, such as a late computer or link.
const MAX_REPETITIONS: u32 = 2;

/// Largest number of equal pushes in a row that show a defect without deciding it; after them the
/// next push follows.
const MAX_EQUAL_PUSHES: u32 = 4;

/// Largest number of further pushes while the encoders may be exchanged.
const MAX_DOUBTFUL_PUSHES: u32 = 12;

const MOTOR: &str = "motor";
const STALL: &str = "stall";
const ARM: &str = "arm";
const PENDULUM: &str = "pendulum";
const ARM_SIGN: &str = "arm-sign";
const PENDULUM_SIGN: &str = "pendulum-sign";
const MOTOR_SIGN: &str = "motor-sign";

/// Names of the checks of motor, encoders and signs, in the order of the report.
const ALL: [&str; 7] = [MOTOR, STALL, ARM, PENDULUM, ARM_SIGN, PENDULUM_SIGN, MOTOR_SIGN];

/// Reports each check of [`ALL`] as skipped.
pub(super) fn skip(found: &mut Examination, why: &str) {
    skip_these(found, &ALL, why);
}

fn skip_these(found: &mut Examination, names: &[&str], why: &str) {
    found.results.extend(names.iter().map(|name| CheckResult::skipped(name, why)));
}

/// Records the fault that ended a push, reports one check as failed by it, and reports the other
/// checks of [`ALL`] as skipped.
fn give_up(found: &mut Examination, fault: Fault) {
    let value = format!("a fault ended the push: {fault}");
    let remedy = format!("{} Then check again", fault.operator_step());
    let name = if fault.leaves_doubt() { STALL } else { MOTOR };
    for each in ALL {
        found.results.push(if each == name {
            CheckResult::fail(name, value.clone(), remedy.clone())
        } else {
            CheckResult::skipped(each, "not after a fault")
        });
    }
    found.fault = Some(fault);
}

/// Pushes the arm a little, and adds the verdicts on motor, encoders and signs.
pub(super) fn check(
    examined: &mut ExaminedDevice<'_>,
    heat: &mut MotorHeat,
    settings: &ExaminationSettings,
    found: &mut Examination,
) -> Result<(), Interruption> {
    let mut signs = settings.signs;
    let mut seen = match probe(examined, heat, signs, settings)? {
        Probed::Evidence(seen) => seen,
        Probed::Ended(fault) => {
            give_up(found, fault);
            return Ok(());
        }
    };
    if settings.other_signs == OtherSigns::Adopt
        && let Some(right) = right_signs(signs, &seen).filter(|right| *right != signs)
    {
        // Signs that the evidence suggests must pass a second probe.
        signs = right;
        match probe(examined, heat, signs, settings)? {
            Probed::Evidence(again) => seen = again,
            Probed::Ended(fault) => {
                give_up(found, fault);
                return Ok(());
            }
        }
    }
    found.results.extend(verdicts(&seen, signs, signs != settings.signs));
    found.signs = signs;
    Ok(())
}

/// The result of a probe.
enum Probed {
    /// The evidence from all pushes.
    Evidence(Evidence),
    /// A fault ended a push.
    Ended(Fault),
}

/// Pushes to and fro with growing voltage until the evidence suffices or the largest voltage is
/// reached.
fn probe(
    examined: &mut ExaminedDevice<'_>,
    heat: &mut MotorHeat,
    signs: Calibration,
    settings: &ExaminationSettings,
) -> Result<Probed, Interruption> {
    let at_rest = rest::window(examined)?;
    let (plant, evidence) = (&settings.plant, Evidence::default());
    let mut pushes = Pushes { examined, heat, plant, signs, evidence, at_rest, doubtful: 0 };
    for step in 1..=STEPS {
        for direction in [1.0, -1.0] {
            match pushes.repeat(direction * STEP_V * f64::from(step))? {
                AfterPushes::NextPush => {}
                AfterPushes::Enough => return Ok(Probed::Evidence(pushes.evidence)),
                AfterPushes::Ended(fault) => return Ok(Probed::Ended(fault)),
            }
        }
    }
    Ok(Probed::Evidence(pushes.evidence))
}

/// The pushes of a probe so far.
struct Pushes<'a, 'd> {
    examined: &'a mut ExaminedDevice<'d>,
    heat: &'a mut MotorHeat,
    plant: &'a PlantModel,
    /// Signs under which the arm is pushed.
    signs: Calibration,
    /// Evidence from the pushes.
    evidence: Evidence,
    /// Window after the last push that moved something; until then, the window before all pushes.
    at_rest: Option<Window>,
    /// Number of further pushes because the encoders may be exchanged.
    doubtful: u32,
}

/// The end of a push.
enum PushEnding {
    /// The push was completed.
    Probed(Box<SignProbe>),
    /// A fault ended the push.
    Fault(Fault),
}

/// The next step after equal pushes.
enum AfterPushes {
    /// The next push has another direction or voltage.
    NextPush,
    /// The evidence suffices.
    Enough,
    /// A fault ended a push.
    Ended(Fault),
}

impl Pushes<'_, '_> {
    /// Pushes with `push_v` volts. Repeats the push after a fault that points to no defect, and
    /// while its effect is [`PushEffect::SeeAgain`], up to the largest numbers of repetitions.
    fn repeat(&mut self, push_v: f64) -> Result<AfterPushes, Interruption> {
        let (mut disturbed, mut pushes) = (0, 0);
        let mut before = self.at_rest;
        loop {
            let probe = match self.push(push_v)? {
                PushEnding::Probed(probe) => probe,
                PushEnding::Fault(fault)
                    if fault.may_be_repeated() && disturbed < MAX_REPETITIONS =>
                {
                    disturbed += 1;
                    rest::wait_for_the_arm(self.examined, self.plant.encoders.theta)?;
                    before = rest::window(self.examined)?;
                    continue;
                }
                PushEnding::Fault(fault) => return Ok(AfterPushes::Ended(fault)),
            };
            let effect = self.add(probe.trace(), &mut before)?;
            if effect == PushEffect::Enough {
                return Ok(AfterPushes::Enough);
            }
            if effect != PushEffect::NothingMoved {
                rest::wait_for_the_arm(self.examined, self.plant.encoders.theta)?;
            }
            // A defect must show twice before it counts, so the same push follows again.
            pushes += 1;
            if effect != PushEffect::SeeAgain || pushes == MAX_EQUAL_PUSHES {
                return Ok(AfterPushes::NextPush);
            }
        }
    }

    /// Pushes once.
    fn push(&mut self, push_v: f64) -> Result<PushEnding, Interruption> {
        self.examined.ensure_going()?;
        let ExaminedDevice { device, clock, stop, .. } = &mut *self.examined;
        device.hello()?;
        let mut probe = Box::new(SignProbe::new(self.plant, self.signs, push_v));
        let report = drive(*device, *clock, &mut *probe, self.heat, None, stop)?;
        // The hello at the end of the examination confirms after a stop that the motor is off.
        if report.outcome.ending == Ending::Stopped {
            return Err(Interruption::Stopped);
        }
        match fault_after(&report, device.is_hardware()) {
            Some(Fault::LinkGone) => Err(self.examined.link_fault(LinkFault::Gone)),
            Some(fault) => Ok(PushEnding::Fault(fault)),
            None => Ok(PushEnding::Probed(probe)),
        }
    }

    /// Adds a push to the evidence and returns its effect. `before` is the window before the push.
    fn add(
        &mut self,
        trace: &ProbeTrace,
        before: &mut Option<Window>,
    ) -> Result<PushEffect, Interruption> {
        let encoders = self.plant.encoders;
        let mut effect = self.evidence.add(trace);
        if effect != PushEffect::NothingMoved {
            self.at_rest = rest::window(self.examined)?;
            let windows = before.zip(self.at_rest);
            let shifts = windows.map(|(before, now)| now.shifts_from(&before, encoders));
            if let Some(exchanged) = shifts.and_then(|it| self.evidence.add_shifts(it, encoders)) {
                // This shift is not evidence again after the next push.
                (effect, *before) = (exchanged, self.at_rest);
            }
        }
        if effect == PushEffect::Enough
            && may_be_exchanged(self.signs, &self.evidence)
            && self.doubtful < MAX_DOUBTFUL_PUSHES
        {
            self.doubtful += 1;
            effect = PushEffect::SeeAgain;
        }
        Ok(effect)
    }
}

/// Returns whether a sign looks wrong while the encoders may be exchanged: the arm has not shown
/// that it stays where it is pushed. An arm that its cable always pulls back never shows that; its
/// sign is reported after [`MAX_DOUBTFUL_PUSHES`].
fn may_be_exchanged(signs: Calibration, seen: &Evidence) -> bool {
    !seen.arm_stayed() && right_signs(signs, seen).is_some_and(|right| right != signs)
}

/// The signs under which the arm follows the voltage and the pendulum lags behind the arm,
/// concluded from a probe under the signs `signs`. There are always two solutions, because
/// inverting all three signs describes the same machine in a mirror; the function returns the one
/// that changes fewer signs. `None` if arm or pendulum did not move.
fn right_signs(signs: Calibration, seen: &Evidence) -> Option<Calibration> {
    let (theta, alpha, voltage) = match (seen.arm_follows()?, seen.pendulum_lags()?) {
        (true, true) => (false, false, false),
        (true, false) => (false, true, false),
        (false, true) => (false, false, true),
        (false, false) => (true, false, false),
    };
    Some(Calibration {
        theta_inverted: signs.theta_inverted ^ theta,
        alpha_inverted: signs.alpha_inverted ^ alpha,
        voltage_inverted: signs.voltage_inverted ^ voltage,
        ..signs
    })
}

/// The results of the seven checks of [`ALL`], in this order.
fn verdicts(seen: &Evidence, signs: Calibration, are_new: bool) -> Vec<CheckResult> {
    let mut results = vec![motor(seen)];
    if results[0].failed() {
        let why = "needs a motor that draws current";
        results.extend(ALL[1..].iter().map(|name| CheckResult::skipped(name, why)));
        return results;
    }
    results.extend([stall(seen), arm(seen), pendulum(seen)]);
    results.extend(sign_verdicts(seen, signs, are_new));
    results
}

fn motor(seen: &Evidence) -> CheckResult {
    let value = format!("{:.0} mA at {:.2} V", seen.current_a * 1e3, seen.strongest_v);
    if !seen.has_current() {
        return CheckResult::fail(
            MOTOR,
            format!("only {value}, and nothing moves"),
            "switch the Qube's power on and look at its light; if the light is on, the motor's \
             wires are loose",
        );
    }
    if seen.is_weak() {
        let value = format!("{value} are far less than the motor should draw, and nothing moves");
        return CheckResult::fail(MOTOR, value, Fault::MotorWeak.operator_step());
    }
    if seen.has_unexplained_current {
        let value = format!("{value} are more than any motor draws at this voltage");
        return CheckResult::fail(MOTOR, value, Fault::CurrentUnexplained.operator_step());
    }
    CheckResult::pass(MOTOR, value)
}

fn stall(seen: &Evidence) -> CheckResult {
    if seen.something_moved() {
        let value = format!("{:.2} V move the arm", seen.strongest_v);
        return CheckResult::pass(STALL, value);
    }
    CheckResult::fail(
        STALL,
        format!(
            "{:.0} mA flow at {:.2} V, in both directions, and nothing moves",
            seen.current_a * 1e3,
            seen.strongest_v
        ),
        "switch the Qube off and turn the arm by hand: something holds it, so clear its way",
    )
}

fn arm(seen: &Evidence) -> CheckResult {
    if seen.turns_unseen() {
        let value = format!(
            "the motor turns (its current falls by {:.0} % as it speeds up) and no count changes",
            seen.current_drop * 1e2
        );
        return CheckResult::fail(ARM, value, "plug in both encoders' cables");
    }
    if seen.arm_is_dead() {
        return CheckResult::fail(
            ARM,
            "the arm swung the pendulum, and the arm's count did not change",
            "plug in the arm encoder's cable (encoder 0)",
        );
    }
    match seen.arm {
        Some(response) => {
            CheckResult::pass(ARM, format!("its encoder works: {:+.3} rad", response.theta_rad))
        }
        None => CheckResult::skipped(ARM, "nothing moved far enough"),
    }
}

fn pendulum(seen: &Evidence) -> CheckResult {
    match seen.pendulum {
        Pendulum::Alive(lag) => CheckResult::pass(
            PENDULUM,
            format!("its encoder works; its swing is {:.2} of the arm's motion", lag.value.abs()),
        ),
        Pendulum::Dead => {
            let theta_rad = seen.arm.map_or(0.0, |response| response.theta_rad);
            CheckResult::fail(
                PENDULUM,
                format!(
                    "the arm turned by {theta_rad:+.3} rad and the pendulum's count did not change"
                ),
                "make sure that the pendulum is on its shaft and swings freely; then plug in its \
                 encoder's cable (encoder 1)",
            )
        }
        Pendulum::Exchanged { off_rad } => CheckResult::fail(
            PENDULUM,
            format!(
                "it hangs {off_rad:+.3} rad from where it hung before the pushes, and the count of \
                 encoder 0, which should be the arm's, came back: the encoders are exchanged"
            ),
            "exchange the plugs of encoder 0 and encoder 1; if somebody touched the pendulum, \
             check again",
        ),
        Pendulum::Unknown if seen.arm_is_dead() => {
            CheckResult::pass(PENDULUM, "its encoder works: the push swung the pendulum")
        }
        Pendulum::Unknown if seen.turns_unseen() => CheckResult::fail(
            PENDULUM,
            "its count does not change either",
            "plug in its encoder's cable (encoder 1)",
        ),
        Pendulum::Unknown if seen.arm.is_some() => CheckResult::fail(
            PENDULUM,
            "its count moves, but not as a pendulum on this arm",
            "make sure that the pendulum swings freely and nobody touches the Qube, then check again",
        ),
        Pendulum::Unknown => CheckResult::skipped(PENDULUM, "nothing moved far enough"),
    }
}

fn sign_verdicts(seen: &Evidence, signs: Calibration, are_new: bool) -> Vec<CheckResult> {
    let (Some(right), Some(response), Pendulum::Alive(lag)) =
        (right_signs(signs, seen), seen.arm, seen.pendulum)
    else {
        let why = "needs both encoders";
        return ALL[4..].iter().map(|name| CheckResult::skipped(name, why)).collect();
    };
    let note = if are_new { ", as found" } else { "" };
    let (voltage_v, theta_rad) = (response.voltage_v, response.theta_rad);
    let follows = format!(
        "{voltage_v:+.2} V turn the arm by {theta_rad:+.3} rad, pendulum {:+.2}",
        -lag.value
    );
    let verdict = |name: &str, of: &str, is: bool, should: bool| {
        if is == should {
            return CheckResult::pass(name, format!("{of} = {is}{note}"));
        }
        CheckResult::fail(
            name,
            format!("{of} = {is} is wrong: {follows} of the arm's motion"),
            format!("in qube.toml: {of} = {should}"),
        )
        .with_hint(Some(Hint::FindSigns))
    };
    vec![
        verdict(ARM_SIGN, "theta_inverted", signs.theta_inverted, right.theta_inverted),
        verdict(PENDULUM_SIGN, "alpha_inverted", signs.alpha_inverted, right.alpha_inverted),
        verdict(MOTOR_SIGN, "voltage_inverted", signs.voltage_inverted, right.voltage_inverted),
    ]
}
