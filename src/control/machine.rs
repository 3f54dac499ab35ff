//! The state table of control: control thread, homing and tick all use it.

/// A state of control.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ControlState {
    /// No device has answered a hello.
    #[default]
    Idle,
    /// The device has answered a hello; its encoders have no zeros yet.
    Identified,
    /// Amplifier on where a check needs it: the device is being examined.
    Checking,
    /// Examined, amplifier off.
    Checked,
    /// The device has answered a hello after a latched fault: the arm must be seen at rest before
    /// anything moves it.
    Cleared,
    /// Amplifier on: the arm is watched until it has been at rest for 1 s.
    Resting,
    /// Amplifier on: homing is under way.
    Homing,
    /// Homed, amplifier off: a rollout may start.
    Ready,
    /// Amplifier on: the program brings arm and pendulum to rest.
    Settling,
    /// Amplifier on: the policy controls the motor.
    Running,
    /// Amplifier on: the brake stops the arm, because the policy's time is up, the guard ended the
    /// rollout or a stop was requested.
    Braking,
    /// Amplifier on: the brake stops the arm because of a fault.
    Faulting,
    /// Amplifier off, latched: only a new hello leaves this state.
    Faulted,
}

/// An event that may change the state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControlEvent {
    /// The operator or the session requested a hello, and the device answered.
    Hello,
    /// The device did not answer, has restarted or did not arm.
    NoAnswer,
    /// The operator or the session requests an examination.
    Check,
    /// The examination is over.
    Checked,
    /// The operator or the session requests homing.
    Home,
    /// The operator or the session requests a rollout.
    Rollout,
    /// Arm, or arm and pendulum, have been at rest for long enough. In homing: the hanging angle is
    /// known, and arm and pendulum move little enough for a push.
    AtRest,
    /// Homing has measured both zeros.
    Homed,
    /// The policy has used all its steps.
    TimeUp,
    /// The state left the safety box, or the guard ends the rollout.
    LimitLeft,
    /// A stop is requested.
    Stop,
    /// The arm has stopped, or its time to stop is over.
    BrakingEnded,
    /// A fault while link, amplifier and the arm's encoder can be trusted.
    BrakeFault,
    /// A fault after which link, amplifier, motor or the arm's encoder cannot be trusted, for
    /// instance that the device has not confirmed that its amplifier is off. In homing every fault
    /// is this event, because the arm is slow enough to be switched off at once.
    SwitchOffFault,
    /// A count is doubted, while link and amplifier can be trusted: the arm's in any phase, or the
    /// pendulum's while the arm is braked because of it.
    CountDoubted,
}

/// The action with which control responds to an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControlAction {
    /// Continue.
    GoOn,
    /// Lend the device to the examination.
    Lend,
    /// Keep the motor at 0 V and watch.
    Watch,
    /// Move the arm to find the zeros of both encoders.
    Seek,
    /// Bring arm and pendulum to rest.
    Settle,
    /// Let the policy control the motor.
    RunPolicy,
    /// Brake the arm.
    Brake,
    /// Switch the amplifier off.
    Off,
    /// Refuse: the command is not allowed in this state.
    Refuse,
}

impl ControlState {
    /// All states.
    pub const ALL: [Self; 13] = [
        Self::Idle,
        Self::Identified,
        Self::Checking,
        Self::Checked,
        Self::Cleared,
        Self::Resting,
        Self::Homing,
        Self::Ready,
        Self::Settling,
        Self::Running,
        Self::Braking,
        Self::Faulting,
        Self::Faulted,
    ];

    /// Returns whether the amplifier is on.
    #[must_use]
    pub fn is_powered(self) -> bool {
        use ControlState::{Braking, Checking, Faulting, Homing, Resting, Running, Settling};
        matches!(self, Checking | Resting | Homing | Settling | Running | Braking | Faulting)
    }

    /// The next state and the action for an event in this state.
    ///
    /// Unless a line of the table states otherwise, the commands (`Hello`, `Check`, `Home`,
    /// `Rollout`) are refused, and all other events are ignored. For each event that must not be
    /// missed (a stop, a fault, a lost answer, a doubted count) every state is listed, so that a
    /// new state does not compile before its responses are decided.
    #[must_use]
    pub fn on(self, event: ControlEvent) -> (Self, ControlAction) {
        use ControlAction as A;
        use ControlEvent as E;
        use ControlState as S;
        let refused = (self, A::Refuse);
        let ignored = (self, A::GoOn);
        let latched = (S::Faulted, A::Off);
        let braking = (S::Braking, A::Brake);
        let faulting = (S::Faulting, A::Brake);
        match (self, event) {
            (S::Idle | S::Identified | S::Checked | S::Ready, E::Hello) => (S::Identified, A::GoOn),
            (S::Faulted | S::Cleared, E::Hello) => (S::Cleared, A::GoOn),
            (_, E::Hello) => refused,

            (S::Identified | S::Checked | S::Ready, E::Check) => (S::Checking, A::Lend),
            (_, E::Check) => refused,

            (S::Checking, E::Checked) => (S::Checked, A::Off),
            (_, E::Checked) => ignored,

            (S::Identified | S::Checked | S::Ready, E::Home) => (S::Homing, A::Watch),
            (S::Cleared, E::Home) => (S::Resting, A::Watch),
            (_, E::Home) => refused,

            (S::Ready, E::Rollout) => (S::Settling, A::Settle),
            (_, E::Rollout) => refused,

            (S::Resting, E::AtRest) => (S::Homing, A::Watch),
            (S::Homing, E::AtRest) => (S::Homing, A::Seek),
            (S::Settling, E::AtRest) => (S::Running, A::RunPolicy),
            (_, E::AtRest) => ignored,

            (S::Homing, E::Homed) => (S::Ready, A::Off),
            (_, E::Homed) => ignored,

            (S::Running, E::TimeUp | E::LimitLeft) => braking,
            (_, E::TimeUp | E::LimitLeft) => ignored,

            (S::Settling | S::Running, E::Stop) => braking,
            (S::Resting, E::Stop) => (S::Cleared, A::Off),
            // The arm is slow here, so switching off stops it.
            (S::Homing, E::Stop) => (S::Identified, A::Off),
            // The arm is being stopped already, and a stop does not change the ending.
            (S::Braking | S::Faulting, E::Stop) => ignored,
            (
                S::Idle
                | S::Identified
                | S::Checking
                | S::Checked
                | S::Cleared
                | S::Ready
                | S::Faulted,
                E::Stop,
            ) => ignored,

            (S::Braking, E::BrakingEnded) => (S::Ready, A::Off),
            (S::Faulting, E::BrakingEnded) => latched,
            (_, E::BrakingEnded) => ignored,

            (S::Identified, E::NoAnswer) => (S::Idle, A::Off),
            (
                S::Checking
                | S::Checked
                | S::Cleared
                | S::Resting
                | S::Homing
                | S::Ready
                | S::Settling
                | S::Running
                | S::Braking
                | S::Faulting,
                E::NoAnswer,
            ) => latched,
            (S::Idle | S::Faulted, E::NoAnswer) => ignored,

            (S::Settling | S::Running, E::BrakeFault) => faulting,
            (
                S::Idle
                | S::Identified
                | S::Checking
                | S::Checked
                | S::Cleared
                | S::Resting
                | S::Homing
                | S::Ready,
                E::BrakeFault,
            ) => latched,
            (S::Braking | S::Faulting | S::Faulted, E::BrakeFault) => ignored,

            (
                S::Idle
                | S::Identified
                | S::Checking
                | S::Checked
                | S::Cleared
                | S::Resting
                | S::Homing
                | S::Ready
                | S::Settling
                | S::Running
                | S::Braking
                | S::Faulting,
                E::SwitchOffFault,
            ) => latched,
            (S::Faulted, E::SwitchOffFault) => ignored,

            (S::Settling | S::Running | S::Braking, E::CountDoubted) => faulting,
            (
                S::Idle
                | S::Identified
                | S::Checking
                | S::Checked
                | S::Cleared
                | S::Resting
                | S::Homing
                | S::Ready,
                E::CountDoubted,
            ) => latched,
            (S::Faulting | S::Faulted, E::CountDoubted) => ignored,
        }
    }

    /// Applies an event and returns the action.
    pub fn take(&mut self, event: ControlEvent) -> ControlAction {
        let (next, action) = self.on(event);
        *self = next;
        action
    }
}

impl ControlEvent {
    /// All events.
    pub const ALL: [Self; 15] = [
        Self::Hello,
        Self::NoAnswer,
        Self::Check,
        Self::Checked,
        Self::Home,
        Self::Rollout,
        Self::AtRest,
        Self::Homed,
        Self::TimeUp,
        Self::LimitLeft,
        Self::Stop,
        Self::BrakingEnded,
        Self::BrakeFault,
        Self::SwitchOffFault,
        Self::CountDoubted,
    ];
}

/// All transitions to another state as a Mermaid state diagram, which SAFETY.md shows; a test
/// compares the two.
#[must_use]
pub fn state_diagram() -> String {
    let mut text = String::from("stateDiagram-v2\n    [*] --> Idle\n");
    for state in ControlState::ALL {
        for target in ControlState::ALL {
            let events: Vec<String> = ControlEvent::ALL
                .into_iter()
                .filter(|event| target != state && state.on(*event).0 == target)
                .map(|event| format!("{event:?} / {:?}", state.on(event).1))
                .collect();
            if !events.is_empty() {
                text.push_str(&format!("    {state:?} --> {target:?}: {}\n", events.join(", ")));
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::{ControlAction as A, ControlEvent as E, ControlState as S, state_diagram};

    fn every_pair() -> impl Iterator<Item = (S, E, S, A)> {
        S::ALL.into_iter().flat_map(|state| {
            E::ALL.into_iter().map(move |event| {
                let (next, action) = state.on(event);
                (state, event, next, action)
            })
        })
    }

    #[test]
    fn the_lists_hold_every_state_and_event_once() {
        for (index, state) in S::ALL.into_iter().enumerate() {
            assert_eq!(state as usize, index);
        }
        for (index, event) in E::ALL.into_iter().enumerate() {
            assert_eq!(event as usize, index);
        }
    }

    #[test]
    fn every_event_in_every_state_keeps_the_rules() {
        for (state, event, next, action) in every_pair() {
            let step = format!("{state:?} on {event:?}: {next:?}, {action:?}");
            // Only the commands Check, Home and Rollout switch the amplifier on, and only the
            // action Off switches it off.
            if !state.is_powered() && next.is_powered() {
                assert!(matches!(event, E::Check | E::Home | E::Rollout), "{step}");
            }
            if state.is_powered() && !next.is_powered() {
                assert_eq!(action, A::Off, "{step}");
            }
            // A SwitchOffFault leads to the latch at once, from every state. A BrakeFault leads
            // there at once or through the brake; if the brake is already on, it changes nothing.
            if event == E::SwitchOffFault {
                assert_eq!(next, S::Faulted, "{step}");
            }
            if event == E::BrakeFault {
                let stops = matches!(next, S::Faulted | S::Faulting | S::Braking);
                assert!(stops && action != A::RunPolicy, "{step}");
            }
            // After a doubted count the arm is braked in the states in which it may be fast; in all
            // others the amplifier is switched off.
            if event == E::CountDoubted {
                let damps = matches!(state, S::Settling | S::Running | S::Braking | S::Faulting);
                assert_eq!(next, if damps { S::Faulting } else { S::Faulted }, "{step}");
            }
            // Only a hello releases the latch, and then nothing moves before 1 s at rest.
            if state == S::Faulted {
                assert_eq!(next != S::Faulted, event == E::Hello, "{step}");
                assert!(event != E::Hello || next == S::Cleared, "{step}");
            }
            if state == S::Faulting {
                assert!(matches!(next, S::Faulting | S::Faulted), "{step}");
            }
            if state == S::Cleared && next.is_powered() {
                assert_eq!(next, S::Resting, "{step}");
            }
            if state == S::Resting && next == S::Homing {
                assert_eq!(event, E::AtRest, "{step}");
            }
            // The policy gets the motor only after homing and settling.
            if action == A::RunPolicy {
                assert_eq!((state, event, next), (S::Settling, E::AtRest, S::Running), "{step}");
            }
            if next == S::Settling && state != S::Settling {
                assert_eq!((state, event), (S::Ready, E::Rollout), "{step}");
            }
            if next == S::Ready && state != S::Ready {
                assert!(
                    matches!((state, event), (S::Homing, E::Homed) | (S::Braking, E::BrakingEnded)),
                    "{step}"
                );
            }
            // A stop takes effect in every state in which the motor may turn fast.
            if event == E::Stop && matches!(state, S::Settling | S::Running) {
                assert_eq!((next, action), (S::Braking, A::Brake), "{step}");
            }
            if action == A::Refuse {
                assert_eq!(next, state, "{step}");
            }
        }
    }

    #[test]
    fn every_state_can_be_reached_and_left() {
        let mut reached = vec![S::Idle];
        while let Some((_, _, next, _)) = every_pair()
            .find(|(state, _, next, _)| reached.contains(state) && !reached.contains(next))
        {
            reached.push(next);
        }
        assert_eq!(reached.len(), S::ALL.len());
        for state in S::ALL {
            assert!(every_pair().any(|(from, _, next, _)| from == state && next != state));
        }
    }

    #[test]
    fn the_picture_in_safety_md_shows_the_transitions_of_the_table() {
        let page = include_str!("../../SAFETY.md");
        let diagram = state_diagram();
        assert!(page.contains(&diagram), "SAFETY.md needs this picture:\n\n{diagram}");
    }
}
