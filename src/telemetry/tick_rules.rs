use serde::{Deserialize, Serialize};

/// The versions of the tick's rules for settling, watching and braking, from the oldest to the
/// newest. Each version has the rules of the version before it, with the additions and changes that
/// its entry names. A recording names its version, so that its replay follows the same rules.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TickRules {
    /// The rules without the additions of the later versions; recordings that name no rules follow
    /// this version.
    #[default]
    First,
    /// Checks the two encoders against each other, settles gently, and lets a braked arm come to
    /// rest anywhere that is not near a stop.
    #[serde(rename = "witnessed")]
    CrossChecked,
    /// Before the motor goes off, damps an arm whose count comes into doubt under a policy or while
    /// it is braked.
    Damped,
    /// Reduces the gain of a brake that oscillates, and damps an arm whose count is in doubt also
    /// while it settles.
    #[serde(rename = "yielding")]
    GainReducing,
    /// Lets foresight simulate each voltage of the brake before it is sent, and take into account
    /// how old a velocity is after lost samples.
    #[serde(rename = "tried")]
    BrakeSimulating,
    /// Reports a fault of the arm before an overheated motor or a late computer in the same tick,
    /// and gives an arm that comes into doubt while it is braked no more time to stop.
    FaultsFirst,
    /// Takes into account, in the tests for a frozen encoder, a held arm and a dead motor, a
    /// voltage that alternates between two samples, and the pendulum's load while the count was
    /// constant; reduces the gain of settling after 4 s.
    AlternatingAllowed,
    /// Reduces the gains of settling that oscillates, to a fifth at the least, and lets the trim of
    /// settling grow more slowly where the gains have fallen.
    SettlingGainReducing,
    /// Lets encoders with fewer counts than a Qube's flicker by one count at rest.
    RestByEncoders,
    /// Computes the motor's heat from the speed that the guard sees, and not from the speed that
    /// the policy sees.
    HeatByGuardedSpeed,
    /// Adds the faults of an arm's count that drifts away from the tachometer, and of a jump of the
    /// pendulum's count for which the guard has begun to brake.
    DriftTested,
    /// Adds the fault of a computer that skips control periods again and again. A policy that
    /// overheats the motor ends with [`Ending::LeftBox`](super::Ending::LeftBox) and not with a
    /// fault.
    SlownessTested,
    /// Adds the faults of a device that reports another voltage at its motor than it was sent, and
    /// of an arm that is fast after a second of braking.
    VoltageCompared,
    /// Keeps a fault that leaves a doubt as the ending if another fault, which leaves none,
    /// switches the motor off while the arm is still damped or braked.
    DoubtKept,
    /// Voids a rollout whose pendulum's count proves frozen while the arm is braked for another
    /// reason, and lets the brake go on while the pendulum stands upright.
    PendulumWaited,
}

impl TickRules {
    /// The rules of this program.
    pub const NEWEST: Self = Self::PendulumWaited;

    /// Returns whether the two encoders are checked against each other.
    pub(crate) fn cross_checks_encoders(self) -> bool {
        self >= Self::CrossChecked
    }

    /// Returns whether the clocks of device and host are compared.
    pub(crate) fn compares_clocks(self) -> bool {
        self >= Self::CrossChecked
    }

    /// Returns whether settling moves target and voltage slowly.
    pub(crate) fn settles_gently(self) -> bool {
        self >= Self::CrossChecked
    }

    /// Returns whether a braked arm may come to rest anywhere that is not near a stop.
    pub(crate) fn rests_off_stops(self) -> bool {
        self >= Self::CrossChecked
    }

    /// Returns whether an arm with a constant count is pushed to test whether it can move.
    pub(crate) fn pushes_constant_arm(self) -> bool {
        self >= Self::CrossChecked
    }

    /// Returns whether an arm whose count comes into doubt under a policy or a brake is damped
    /// before the motor goes off.
    pub(crate) fn damps_doubted_count(self) -> bool {
        self >= Self::Damped
    }

    /// Returns whether an arm whose count comes into doubt is damped also while it settles.
    pub(crate) fn damps_while_settling(self) -> bool {
        self >= Self::GainReducing
    }

    /// Returns whether a brake that oscillates loses gain.
    pub(crate) fn reduces_gain_of_brake(self) -> bool {
        self >= Self::GainReducing
    }

    /// Returns whether foresight simulates each voltage of the brake before it is sent.
    pub(crate) fn simulates_brake(self) -> bool {
        self >= Self::BrakeSimulating
    }

    /// Returns whether foresight takes into account how old a velocity is after lost samples.
    pub(crate) fn ages_velocities(self) -> bool {
        self >= Self::BrakeSimulating
    }

    /// Returns whether the most urgent of several alarms in a tick is reported, and not the first.
    pub(crate) fn reports_most_urgent(self) -> bool {
        self >= Self::FaultsFirst
    }

    /// Returns whether an arm that comes into doubt while it is braked gets no more time to stop.
    pub(crate) fn keeps_braking_time(self) -> bool {
        self >= Self::FaultsFirst
    }

    /// Returns whether the tests of a count allow for a voltage that alternates between two
    /// samples, and for the pendulum's load while the count was constant.
    pub(crate) fn allows_alternating(self) -> bool {
        self >= Self::AlternatingAllowed
    }

    /// Returns whether the gains of settling fall after 4 s.
    pub(crate) fn slows_long_settling(self) -> bool {
        self >= Self::AlternatingAllowed
    }

    /// Returns whether settling that oscillates loses gain.
    pub(crate) fn reduces_gain_of_settling(self) -> bool {
        self >= Self::SettlingGainReducing
    }

    /// Returns whether coarse encoders may flicker by one count at rest.
    pub(crate) fn rests_by_encoders(self) -> bool {
        self >= Self::RestByEncoders
    }

    /// Returns whether the motor's heat is computed from the speed that the guard sees.
    pub(crate) fn heats_by_guarded_speed(self) -> bool {
        self >= Self::HeatByGuardedSpeed
    }

    /// Returns whether the arm's count is tested for a drift away from the tachometer.
    pub(crate) fn tests_drift(self) -> bool {
        self >= Self::DriftTested
    }

    /// Returns whether a jump of the pendulum's count is reported as the reason for a brake that
    /// has just begun.
    pub(crate) fn explains_brake_by_jump(self) -> bool {
        self >= Self::DriftTested
    }

    /// Returns whether a computer that skips control periods again and again is a fault.
    pub(crate) fn tests_slowness(self) -> bool {
        self >= Self::SlownessTested
    }

    /// Returns whether a policy that overheats the motor has left a limit, which is no fault.
    pub(crate) fn limits_by_motor(self) -> bool {
        self >= Self::SlownessTested
    }

    /// Returns whether a device that reports another voltage than it was sent is a fault.
    pub(crate) fn compares_voltages(self) -> bool {
        self >= Self::VoltageCompared
    }

    /// Returns whether an arm that is fast after a second of braking is a fault.
    pub(crate) fn tests_braked_speed(self) -> bool {
        self >= Self::VoltageCompared
    }

    /// Returns whether a pendulum's count that proves frozen while the arm is braked voids the
    /// rollout.
    pub(crate) fn voids_frozen_pendulum(self) -> bool {
        self >= Self::PendulumWaited
    }

    /// Returns whether the brake goes on while the pendulum stands upright.
    pub(crate) fn waits_for_pendulum(self) -> bool {
        self >= Self::PendulumWaited
    }

    /// Returns whether a fault that leaves a doubt stays the ending if another fault, which leaves
    /// none, switches the motor off.
    pub(crate) fn keeps_doubts(self) -> bool {
        self >= Self::DoubtKept
    }
}
