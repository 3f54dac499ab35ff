//! The table of faults: the cause of each, the operator's step, and the program's reaction.
//! `docs/faults.md` contains this table; a test compares them.

use serde::{Deserialize, Serialize};

/// The program's reaction to a fault. The motor is off, except perhaps after a lost link or where
/// the device has not confirmed that it is off.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Consequence {
    /// A session or experiment repeats the rollout a limited number of times, because nothing
    /// points to a defect of the Qube. Before each repetition it sends the board a hello, waits
    /// until the arm has been at rest for 1 s, and homes.
    TryAgain,
    /// The program opens the same port again, because the link is lost. It tries for a limited time
    /// and accepts only the same board. Then it continues as with [`TryAgain`](Self::TryAgain),
    /// with a new zero.
    Reconnect,
    /// The run or session ends, because a sensor or the motor is in doubt, or somebody has stopped
    /// the Qube or switched it off. Nothing moves before an operator has acknowledged the fault and
    /// an examination has passed.
    Examine,
    /// The run or session ends, because a repetition would end the same way.
    End,
}

impl Consequence {
    /// The reaction in words for the operator, without the subject: the program.
    #[must_use]
    pub fn sentence(self) -> &'static str {
        match self {
            Self::TryAgain => {
                "sends a hello, waits for rest, homes and tries again, by default at most 3 times"
            }
            Self::Reconnect => {
                "tries for 30 s by default to open the same port again, with the same board; then homes the arm \
                 and repeats the rollout"
            }
            Self::Examine => {
                "ends; nothing moves until the operator has acknowledged the fault and the Qube has \
                 passed an examination"
            }
            Self::End => "ends",
        }
    }
}

/// The state of the motor after a motion.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MotorState {
    /// The device has confirmed that its motor is off.
    Off,
    /// The device has not confirmed that its motor is off; the motor may have its last voltage.
    Unconfirmed,
}

/// Generates [`Fault`] with its causes, reactions and operator's steps from the rows of the table.
macro_rules! faults {
    ($($(#[$attribute:meta])* $fault:ident: $consequence:ident, $cause:literal, $operator:literal;)+) => {
        /// A reason for which the program has switched the motor off. The motor stays off.
        #[derive(Clone, Copy, Debug, thiserror::Error, PartialEq, Eq, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub enum Fault {
            $(
                #[doc = $cause]
                $(#[$attribute])*
                #[error($cause)]
                $fault,
            )+
        }

        impl Fault {
            /// Every fault, in the order of the table.
            pub const ALL: &[Self] = &[$(Self::$fault),+];

            /// The program's reaction.
            #[must_use]
            pub fn consequence(self) -> Consequence {
                match self {
                    $(Self::$fault => Consequence::$consequence,)+
                }
            }

            /// The operator's step in whole sentences.
            #[must_use]
            pub fn operator_step(self) -> &'static str {
                match self {
                    $(Self::$fault => $operator,)+
                }
            }
        }
    };
}

// Columns: fault, consequence, cause, operator's step. Recordings contain the names of the faults,
// so the names never change.
faults! {
    NoSample: TryAgain,
        "no valid sample for more than 35 ms",
        "Close programs that keep this computer busy; try another cable or USB port.";
    LinkGone: Reconnect,
        "the port is gone (unplugged?)",
        "Switch the Qube off: its motor may still have its last voltage. Plug the cable in, then switch the Qube on.";
    BoardRestarted: Reconnect,
        "the board has restarted (a loss of power?)",
        "Switch the Qube off: its motor may still have its last voltage. Check the board's supply and its USB cable.";
    OffUnconfirmed: Reconnect,
        "the device has not confirmed that the motor is off",
        "Switch the Qube off: its motor may still have its last voltage. Check the board's supply and its USB cable.";
    WatchdogTripped: TryAgain,
        "the device's watchdog switched the motor off",
        "Close programs that keep this computer busy.";
    NotArmed: TryAgain,
        "the device was disarmed in the middle of a motion",
        "Check whether another program uses the board; check the wires between board and Qube.";
    EmergencyStop: Examine,
        "the emergency-stop switch was opened",
        "Make sure that nobody is near the arm, then close the switch. If nobody has opened it, check its wires.";
    QubeOff: Examine,
        "the Qube does not answer its board (switched off, or its supply gone?)",
        "Make sure that nobody is near the arm, then switch the Qube on. If nobody has switched it off, check its supply and its wires to the board.";
    DeviceClock: TryAgain,
        "the device's clock disagrees with the computer's, or the same sample came twice",
        "Close programs that keep this computer busy. If the fault persists: flash the firmware of this release, then check that the board conforms to the protocol.";
    ComputerSlept: End,
        "the computer stood still for 2 s or more in the middle of a motion (asleep, or the program was stopped?)",
        "Make sure that nobody is near the arm, then start again. Switch the computer's sleep off while it drives a Qube.";
    CountsMoved: TryAgain,
        "a count of arm or pendulum moved while the motor was off, or may have slipped in a rollout (a hand, or an encoder's cable)",
        "Keep hands off during a run. If nobody touched the Qube: check the cables of both encoders.";
    TooLate: TryAgain,
        "five ticks in a row were more than 10 ms late, or this computer skipped control periods again and again",
        "Close programs that keep this computer busy; a controller must decide within 10 ms.";
    Amplifier: Examine,
        "the amplifier reports a fault",
        "Switch the Qube off, let it cool down, check its supply and the motor.";
    VoltageDiffers: Examine,
        "the device reports another voltage at its motor than the program has sent",
        "Switch the Qube off: its motor does not follow the program. Check the board, its firmware and its wires.";
    StaysArmed: Examine,
        "the device answers that its motor is still on",
        "Switch the Qube off; check the board, its firmware and its wires.";
    CurrentUnexplained: Examine,
        "more current flows through the motor than its voltage explains (a defect of the amplifier or of its current sensor?)",
        "Switch the Qube off: its motor may be driven without a command. Check the board and its wires.";
    StallError: Examine,
        "the Qube reports a stall and has switched its motor off",
        "Free the arm; check whether cables have wound around it.";
    MotorOverheated: End,
        "the motor's load has reached 90 % of its continuous rating",
        "Let the motor cool down for ten minutes; use a policy that pushes less.";
    NotANumber: End,
        "the policy requested a voltage that is not a number",
        "Use another policy: this one is invalid.";
    EncoderJump: Examine,
        "the arm's encoder jumped: in 10 ms by more than 200 counts, or by 40 more than just before and after (a hard hit?)",
        "Check the arm's encoder, its cable and the stops.";
    PendulumJump: Examine,
        "the pendulum's encoder jumped: in 10 ms by more than 200 counts, or by 40 more than just before and after (a loose cable?)",
        "Check the pendulum's encoder cable and its plug.";
    EncoderFrozen: Examine,
        "the arm's count is constant while the arm moves (a loose cable?)",
        "Check the arm's encoder, its cable and its plug, and whether the base is level within half a degree; the check shows whether the two encoders are exchanged.";
    PendulumFrozen: Examine,
        "the pendulum's count is constant while the arm accelerates (a loose cable?)",
        "Check the pendulum's encoder cable and its plug; the check shows whether the two encoders are exchanged.";
    Stall: Examine,
        "the arm hardly turned for 500 ms against 2 V or more (is something in its way?)",
        "Free the arm; check whether cables have wound around it.";
    TachometerDisagrees: Examine,
        "the arm's counter and its tachometer disagreed for 300 ms",
        "Check the arm's encoder and its cable.";
    EncoderDrifts: Examine,
        "the arm's count and its tachometer have moved apart by more than 0.4 rad: counts were lost, or disturbances were counted",
        "Check the arm's encoder, its cable and its plug.";
    SettlingTimedOut: Examine,
        "arm and pendulum did not come to rest within 15 s",
        "Check whether something moves or holds arm or pendulum; check the cables of both encoders.";
    BrakingTimedOut: Examine,
        "the arm still turned faster than 15 rad/s after 1 s of braking, or faster than 5 rad/s at the end of the time for braking",
        "Switch the Qube off; check the motor and the arm's encoder.";
    HomingTimedOut: Examine,
        "the arm's stops were not found within 60 s",
        "Clear the arm's way from stop to stop; check the motor and the arm's encoder.";
    EncodersDisagree: Examine,
        "the encoders of arm and pendulum contradict each other",
        "Check both encoders' cables; check whether the pendulum sits firmly on its shaft, and keep hands off.";
    WrongSignTheta: Examine,
        "the arm's count moves in the direction opposite to the arm: the sign of its encoder is wrong",
        "Reverse theta_inverted in qube.toml, or let the check find the signs.";
    WrongSignAlpha: Examine,
        "the pendulum's count moves in the direction opposite to the pendulum: the sign of its encoder is wrong",
        "Reverse alpha_inverted in qube.toml, or let the check find the signs.";
    WrongSignMotor: Examine,
        "the arm moves against the voltage: the sign of the motor is wrong",
        "Reverse voltage_inverted in qube.toml, or let the check find the signs.";
    ArmPushed: Examine,
        "something other than the motor moved the arm (a hand, a cable?)",
        "Keep hands and cables off arm and pendulum.";
    MotorDead: Examine,
        "the motor draws no current (is it connected, is the Qube switched on?)",
        "Check whether the Qube is switched on; check its supply and the motor's wires.";
    MotorWeak: Examine,
        "the motor draws far less current than it should at its voltage (a bad contact?)",
        "Check the motor's wires and plug and the Qube's supply.";
    ArmHeld: Examine,
        "the arm's count does not change although the motor pushes (is the arm held, or its encoder's cable loose?)",
        "Free the arm; check whether cables have wound around it, and check its encoder.";
    TravelWrong: Examine,
        "the stops are not as far apart as a Qube's (is something in the arm's way, or does its encoder have another number of lines?)",
        "Clear the arm's way from stop to stop, and check the arm's encoder; if this rig's stops are where they should be, accept their travel with travel_rad under [homing] in qube.toml.";
    TravelBlocked: Examine,
        "the homing of an earlier version found stops that are not as far apart as a Qube's (is something in the arm's way?)",
        "Clear the arm's way from stop to stop; check the arm's encoder.";
}

impl Fault {
    /// The state of the motor after this fault and the operator's step, in whole sentences. After a
    /// lost link nobody knows whether the motor is off, and the step says so.
    #[must_use]
    pub fn motor_and_step(self, motor: MotorState) -> String {
        let step = self.operator_step();
        match motor {
            _ if self.consequence() == Consequence::Reconnect => step.to_owned(),
            MotorState::Off => format!("The motor is off. {step}"),
            MotorState::Unconfirmed => {
                let unconfirmed = "The device has not confirmed that the motor is off: it may still have its last \
                                   voltage. Switch the Qube off.";
                format!("{unconfirmed} {step}")
            }
        }
    }

    /// The name in recordings and JSON.
    #[must_use]
    pub fn name(self) -> String {
        let mut name = String::new();
        for letter in format!("{self:?}").chars() {
            if letter.is_uppercase() && !name.is_empty() {
                name.push('_');
            }
            name.extend(letter.to_lowercase());
        }
        name
    }

    /// Returns whether the rollout may be repeated on the same link, because nothing points to a
    /// defect of the Qube: samples or commands came too late, the clocks disagreed, a sample came
    /// twice, the device was disarmed, or a count moved while the motor was off.
    #[must_use]
    pub fn may_be_repeated(self) -> bool {
        self.consequence() == Consequence::TryAgain
    }

    /// Returns whether the arm is damped by its count's velocity before the motor goes off, because
    /// the count may be right although a test has failed
    /// ([`TickRules::Damped`](super::TickRules::Damped)). [`EncoderDrifts`](Self::EncoderDrifts) is
    /// not among these faults, because the count's velocity is then wrong.
    #[must_use]
    pub fn doubts_count(self) -> bool {
        matches!(
            self,
            Self::EncoderFrozen | Self::ArmHeld | Self::Stall | Self::TachometerDisagrees
        )
    }

    /// Returns whether the program may repeat the motion after this fault without the operator,
    /// because only the link or the computer failed.
    #[must_use]
    pub fn is_passing(self) -> bool {
        matches!(self.consequence(), Consequence::TryAgain | Consequence::Reconnect)
    }

    /// Returns whether the fault leaves a sensor or the motor in doubt.
    #[must_use]
    pub fn leaves_doubt(self) -> bool {
        self.consequence() == Consequence::Examine
    }
}

/// The table as Markdown, as `docs/faults.md` contains it.
#[must_use]
pub fn fault_table() -> String {
    let mut text = String::from(
        "| fault | cause | the operator's step | the program's reaction |\n\
         | --- | --- | --- | --- |\n",
    );
    for fault in Fault::ALL {
        let (name, step) = (fault.name(), fault.operator_step());
        let reaction = fault.consequence().sentence();
        text.push_str(&format!("| `{name}` | {fault} | {step} | {reaction} |\n"));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_of_faults_in_the_docs_is_that_of_the_code() {
        let page = include_str!("../../docs/faults.md");
        let table = fault_table();
        assert!(page.contains(&table), "docs/faults.md needs this table:\n\n{table}");
    }

    #[test]
    fn a_fault_is_named_as_recordings_name_it() {
        for fault in Fault::ALL {
            assert_eq!(serde_json::to_value(fault).unwrap(), fault.name().as_str());
        }
    }

    #[test]
    fn faults_of_the_link_say_that_the_qube_is_switched_off() {
        let lost = |fault: &&Fault| fault.consequence() == Consequence::Reconnect;
        assert!(Fault::ALL.iter().filter(lost).count() > 0);
        for fault in Fault::ALL.iter().filter(lost) {
            assert!(fault.operator_step().starts_with("Switch the Qube off"), "{fault}");
        }
    }

    #[test]
    fn the_motor_counts_as_off_unless_the_step_says_that_it_may_not_be() {
        for fault in Fault::ALL {
            for motor in [MotorState::Off, MotorState::Unconfirmed] {
                let told = fault.motor_and_step(motor);
                assert!(told.contains(fault.operator_step()), "{fault}");
                let may_run = told.contains("may still have");
                assert_ne!(told.contains("The motor is off"), may_run, "{fault}");
                let reconnects = fault.consequence() == Consequence::Reconnect;
                assert_eq!(may_run, reconnects || motor == MotorState::Unconfirmed, "{fault}");
                assert!(!may_run || told.contains("Switch the Qube off"), "{fault}");
            }
        }
    }
}
