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
    /// Like `Identified`, but after a latched fault: the arm must be seen at rest before anything
    /// moves it.
    Cleared,
    /// Amplifier on: the arm is watched until it has been at rest for 1 s.
    Resting,
    /// Amplifier on: the arm is homed.
    Homing,
    /// Homed, amplifier off: a rollout may start.
    Ready,
    /// Amplifier on: arm and pendulum are brought to rest.
    Settling,
    /// Amplifier on: the policy controls the motor.
    Running,
    /// Amplifier on: the arm is stopped at the regular end of a rollout.
    Braking,
    /// Amplifier on: the arm is stopped because of a fault.
    Faulting,
    /// Amplifier off, latched: only a new hello leaves this state.
    Faulted,
}

/// An event that may change the state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControlEvent {
    /// The operator or the session asked for a hello, and the device answered.
    Hello,
    /// The device did not answer, or did not arm.
    NoAnswer,
    /// The operator asks for an examination.
    Check,
    /// The examination is over.
    Checked,
    /// The operator asks for homing.
    Home,
    /// The operator asks for a rollout.
    Rollout,
    /// Arm, or arm and pendulum, have been at rest for long enough.
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
    Stands,
    /// A fault while link, amplifier and encoders can be trusted.
    BrakeFault,
    /// A fault of link, amplifier or encoder: none of them can be trusted.
    ZeroFault,
    /// The arm's count is doubted, while link and amplifier can be trusted.
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
    /// Move the arm to find its zeros.
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
    /// All states, in the order of the table's rows.
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

    /// Whether the amplifier is on.
    #[must_use]
    pub fn is_powered(self) -> bool {
        use ControlState::{Braking, Checking, Faulting, Homing, Resting, Running, Settling};
        matches!(self, Checking | Resting | Homing | Settling | Running | Braking | Faulting)
    }

    /// The next state and the action for an event in this state.
    #[must_use]
    pub fn on(self, event: ControlEvent) -> (Self, ControlAction) {
        TABLE[self as usize][event as usize]
    }

    /// Applies an event and returns the action.
    pub fn take(&mut self, event: ControlEvent) -> ControlAction {
        let (next, action) = self.on(event);
        *self = next;
        action
    }
}

impl ControlEvent {
    /// All events, in the order of the table's columns.
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
        Self::Stands,
        Self::BrakeFault,
        Self::ZeroFault,
        Self::CountDoubted,
    ];
}

type Entry = (ControlState, ControlAction);

/// Rows: states. Columns: Hello, NoAnswer, Check, Checked, Home, Rollout, AtRest, Homed, TimeUp,
/// LimitLeft, Stop, Stands, BrakeFault, ZeroFault, CountDoubted.
#[rustfmt::skip]
const TABLE: [[Entry; ControlEvent::ALL.len()]; ControlState::ALL.len()] = {
    use ControlAction as A;
    use ControlState as S;
    const fn no(state: S) -> Entry { (state, A::Refuse) }
    const fn rest(state: S) -> Entry { (state, A::GoOn) }
    const KNOWN: Entry = (S::Identified, A::GoOn);
    const LEND: Entry = (S::Checking, A::Lend);
    const HOME: Entry = (S::Homing, A::Watch);
    const LATCH: Entry = (S::Faulted, A::Off);
    const STOP: Entry = (S::Braking, A::Brake);
    const FAIL: Entry = (S::Faulting, A::Brake);
    [
        // Idle
        [KNOWN, rest(S::Idle), no(S::Idle), rest(S::Idle), no(S::Idle), no(S::Idle), rest(S::Idle),
         rest(S::Idle), rest(S::Idle), rest(S::Idle), rest(S::Idle), rest(S::Idle), LATCH, LATCH, LATCH],
        // Identified
        [KNOWN, (S::Idle, A::Off), LEND, rest(S::Identified), HOME, no(S::Identified),
         rest(S::Identified), rest(S::Identified), rest(S::Identified), rest(S::Identified),
         rest(S::Identified), rest(S::Identified), LATCH, LATCH, LATCH],
        // Checking
        [no(S::Checking), LATCH, no(S::Checking), (S::Checked, A::Off), no(S::Checking),
         no(S::Checking), rest(S::Checking), rest(S::Checking), rest(S::Checking),
         rest(S::Checking), rest(S::Checking), rest(S::Checking), LATCH, LATCH, LATCH],
        // Checked
        [KNOWN, LATCH, LEND, rest(S::Checked), HOME, no(S::Checked), rest(S::Checked),
         rest(S::Checked), rest(S::Checked), rest(S::Checked), rest(S::Checked), rest(S::Checked),
         LATCH, LATCH, LATCH],
        // Cleared
        [rest(S::Cleared), LATCH, no(S::Cleared), rest(S::Cleared), (S::Resting, A::Watch),
         no(S::Cleared), rest(S::Cleared), rest(S::Cleared), rest(S::Cleared), rest(S::Cleared),
         rest(S::Cleared), rest(S::Cleared), LATCH, LATCH, LATCH],
        // Resting
        [no(S::Resting), LATCH, no(S::Resting), rest(S::Resting), no(S::Resting), no(S::Resting),
         HOME, rest(S::Resting), rest(S::Resting), rest(S::Resting), (S::Cleared, A::Off),
         rest(S::Resting), LATCH, LATCH, LATCH],
        // Homing: the arm is slow here, so that switching off stops it.
        [no(S::Homing), LATCH, no(S::Homing), rest(S::Homing), no(S::Homing), no(S::Homing),
         (S::Homing, A::Seek), (S::Ready, A::Off), rest(S::Homing), rest(S::Homing),
         (S::Identified, A::Off), rest(S::Homing), LATCH, LATCH, LATCH],
        // Ready
        [KNOWN, LATCH, LEND, rest(S::Ready), HOME, (S::Settling, A::Settle), rest(S::Ready),
         rest(S::Ready), rest(S::Ready), rest(S::Ready), rest(S::Ready), rest(S::Ready), LATCH,
         LATCH, LATCH],
        // Settling
        [no(S::Settling), LATCH, no(S::Settling), rest(S::Settling), no(S::Settling),
         no(S::Settling), (S::Running, A::RunPolicy), rest(S::Settling), rest(S::Settling),
         rest(S::Settling), STOP, rest(S::Settling), FAIL, LATCH, FAIL],
        // Running
        [no(S::Running), LATCH, no(S::Running), rest(S::Running), no(S::Running), no(S::Running),
         rest(S::Running), rest(S::Running), STOP, STOP, STOP, rest(S::Running), FAIL, LATCH, FAIL],
        // Braking: the arm is being stopped already, and a lesser event does not change the ending.
        [no(S::Braking), LATCH, no(S::Braking), rest(S::Braking), no(S::Braking), no(S::Braking),
         rest(S::Braking), rest(S::Braking), rest(S::Braking), rest(S::Braking), rest(S::Braking),
         (S::Ready, A::Off), rest(S::Braking), LATCH, FAIL],
        // Faulting
        [no(S::Faulting), LATCH, no(S::Faulting), rest(S::Faulting), no(S::Faulting),
         no(S::Faulting), rest(S::Faulting), rest(S::Faulting), rest(S::Faulting),
         rest(S::Faulting), rest(S::Faulting), LATCH, rest(S::Faulting), LATCH, rest(S::Faulting)],
        // Faulted
        [(S::Cleared, A::GoOn), rest(S::Faulted), no(S::Faulted), rest(S::Faulted), no(S::Faulted),
         no(S::Faulted), rest(S::Faulted), rest(S::Faulted), rest(S::Faulted), rest(S::Faulted),
         rest(S::Faulted), rest(S::Faulted), rest(S::Faulted), rest(S::Faulted), rest(S::Faulted)],
    ]
};

/// The table as a Mermaid state diagram, which SAFETY.md shows; a test compares the two.
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
    fn rows_and_columns_stand_where_their_names_say() {
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
            // Only a command of the operator switches the amplifier on, and only the action Off
            // switches it off.
            if !state.is_powered() && next.is_powered() {
                assert!(matches!(event, E::Check | E::Home | E::Rollout), "{step}");
            }
            if state.is_powered() && !next.is_powered() {
                assert_eq!(action, A::Off, "{step}");
            }
            // A fault leads to the latch from every state, directly or through the brake.
            if event == E::ZeroFault {
                assert_eq!(next, S::Faulted, "{step}");
            }
            if event == E::BrakeFault {
                let stops = matches!(next, S::Faulted | S::Faulting | S::Braking);
                assert!(stops && action != A::RunPolicy, "{step}");
            }
            // A doubted count is damped in states in which the arm may be fast, and switches off in
            // all others.
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
                    matches!((state, event), (S::Homing, E::Homed) | (S::Braking, E::Stands)),
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
    fn the_picture_in_safety_md_is_that_of_the_table() {
        let page = include_str!("../../SAFETY.md");
        let diagram = state_diagram();
        assert!(page.contains(&diagram), "SAFETY.md needs this picture:\n\n{diagram}");
    }
}
