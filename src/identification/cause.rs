//! Finds the likely reason why no Qube explains some recordings.

use std::fmt;

use crate::replay::MotionLog;

/// Share of the fit's residual below which the residual of a fit with a reversed sign must lie for
/// the sign to be named.
const SIGN_FACTOR: f64 = 0.5;

/// The likely reason why no Qube explains the recordings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// The sign with whose reversal a Qube explains them.
    Reversed(Sign),
    /// The sign with whose reversal a Qube explains the only recording that no Qube explains alone.
    ReversedIn {
        /// Index of the recording.
        index: usize,
        /// Sign that differs from the signs of the other recordings.
        sign: Sign,
    },
    /// A Qube explains each recording alone, but none explains all.
    EachAlone,
    /// No reversed sign explains them.
    Unknown,
}

/// A sign of the rig's calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sign {
    /// The sign of the voltage.
    Voltage,
    /// The sign of the arm's encoder.
    Arm,
    /// The sign of the pendulum's encoder.
    Pendulum,
}

impl Sign {
    /// All signs.
    pub const ALL: [Self; 3] = [Self::Voltage, Self::Arm, Self::Pendulum];
}

impl fmt::Display for Sign {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str(match self {
            Self::Voltage => "the voltage",
            Self::Arm => "the arm's angle",
            Self::Pendulum => "the pendulum's angle",
        })
    }
}

impl fmt::Display for Cause {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Unknown => f.write_str(
                "No reversed sign explains them either: are all recordings of one Qube, is the pendulum a different one, \
                 is a value that was kept fixed wrong, or does something in the drive slip or stick?",
            ),
            Self::EachAlone => f.write_str(
                "A Qube explains each recording alone: are all recordings of one Qube, with the same signs?",
            ),
            Self::Reversed(sign) => {
                write!(f, "With the sign of {sign} reversed, a Qube explains them: check that sign")
            }
            Self::ReversedIn { index, sign } => {
                let number = index + 1;
                write!(
                    f,
                    "With the sign of {sign} reversed in recording {number} alone, a Qube explains it: was it made with \
                     other signs?"
                )
            }
        }
    }
}

impl Cause {
    /// Finds the likely reason. `residual_rad` is the residual of the best fit to all recordings;
    /// `explained` returns the residual, rad, of the best plausible fit to some recordings,
    /// infinite if there is none, and `largest_rad` is the residual up to which a fit explains
    /// them.
    ///
    /// A sign is named only if its reversal explains the recordings: an operator who reverses a
    /// correct sign has a worse rig than before. If one recording alone has another sign, the
    /// reversal of another sign in all of them may fit better than none, and still explain nothing.
    pub(super) fn of(
        logs: &[MotionLog],
        residual_rad: f64,
        largest_rad: f64,
        explained: impl Fn(&[MotionLog]) -> f64,
    ) -> Self {
        let with_reversed = |sign: Sign| {
            let reversed: Vec<MotionLog> = logs.iter().map(|log| reversed(log, sign)).collect();
            (sign, explained(&reversed))
        };
        let best = Sign::ALL.map(with_reversed).into_iter().min_by(|a, b| a.1.total_cmp(&b.1));
        if let Some((sign, residual)) = best
            && residual < SIGN_FACTOR * residual_rad
            && residual <= largest_rad
        {
            return Self::Reversed(sign);
        }
        if residual_rad <= largest_rad || logs.len() < 2 {
            return Self::Unknown;
        }
        let is_explained = |log: &MotionLog| explained(std::slice::from_ref(log)) <= largest_rad;
        let mut unexplained = (0..logs.len()).filter(|&index| !is_explained(&logs[index]));
        match (unexplained.next(), unexplained.next()) {
            (None, _) => Self::EachAlone,
            (Some(index), None) => Sign::ALL
                .into_iter()
                .find(|&sign| is_explained(&reversed(&logs[index], sign)))
                .map_or(Self::Unknown, |sign| Self::ReversedIn { index, sign }),
            _ => Self::Unknown,
        }
    }
}

/// The recording with one sign reversed.
fn reversed(log: &MotionLog, sign: Sign) -> MotionLog {
    let mut log = log.clone();
    for sample in &mut log.samples {
        let state = &mut sample.state;
        match sign {
            Sign::Voltage => sample.voltage_v = -sample.voltage_v,
            Sign::Arm => (state.theta, state.theta_dot) = (-state.theta, -state.theta_dot),
            Sign::Pendulum => (state.alpha, state.alpha_dot) = (-state.alpha, -state.alpha_dot),
        }
    }
    log
}
