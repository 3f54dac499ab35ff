//! The states that control can be in and what leads from one to the next: one table, which the
//! control thread, homing and the tick run on.

/// Where control is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ControlState {
    /// Nobody has said who is at the other end of the link.
    #[default]
    Idle,
    /// The device has said hello; its encoders count from anywhere.
    Identified,
    /// Amplifier on where a check needs it: the device is examined before anything relies on it.
    Checking,
    /// Examined, amplifier off.
    Checked,
    /// As `Identified`, after a latched fault: nothing moves before the arm has been at rest.
    Cleared,
    /// Amplifier on: the arm is watched until it has been at rest for 1 s.
    Resting,
    /// Amplifier on: the arm looks for its stops.
    Homing,
    /// Homed, amplifier off: a rollout may start.
    Ready,
    /// Amplifier on: arm and pendulum are brought to rest.
    Settling,
    /// Amplifier on: the policy has the motor.
    Running,
    /// Amplifier on: the arm is stopped, and all is well.
    Braking,
    /// Amplifier on: the arm is stopped because of a fault.
    Faulting,
    /// Amplifier off, latched: only a new hello leads out.
    Faulted,
}

/// What happens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControlEvent {
    /// The operator (or the session's policy) asked who is there, and the device answered.
    Hello,
    /// It did not, or it would not arm.
    NoAnswer,
    /// The operator wants the device examined.
    Check,
    /// That is over.
    Checked,
    /// The operator wants the arm homed.
    Home,
    /// The operator wants a rollout.
    Rollout,
    /// Arm, or arm and pendulum, have been at rest for long enough.
    AtRest,
    /// Homing knows both zeros.
    Homed,
    /// The policy has had all its steps.
    TimeUp,
    /// The safety box is left, or the guard ends the rollout.
    LimitLeft,
    /// Somebody asks to stop.
    Stop,
    /// The arm stands, or has had the time to.
    Stands,
    /// A fault while link, amplifier and encoders can be trusted.
    BrakeFault,
    /// A fault of link, amplifier or encoder.
    ZeroFault,
    /// The arm's count is doubted while link and amplifier can be trusted.
    CountDoubted,
}

/// What control does from now on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ControlAction {
    /// What it did before.
    GoOn,
    /// Lend the device to whoever examines it.
    Lend,
    /// Hold the arm loosely and watch.
    Watch,
    /// Look for the stops.
    Seek,
    /// Bring arm and pendulum to rest.
    Settle,
    /// Give the motor to the policy.
    RunPolicy,
    /// Work against the arm.
    Brake,
    /// Switch the amplifier off.
    Off,
    /// Nothing: it cannot be asked for here.
    Refuse,
}

impl ControlState {
    /// All of them, in the order of the table's rows.
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

    /// What an event does here.
    #[must_use]
    pub fn on(self, event: ControlEvent) -> (Self, ControlAction) {
        TABLE[self as usize][event as usize]
    }

    /// Takes the event in, and says what to do.
    pub fn take(&mut self, event: ControlEvent) -> ControlAction {
        let (next, action) = self.on(event);
        *self = next;
        action
    }
}

impl ControlEvent {
    /// All of them, in the order of the table's columns.
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

/// Rows: states. Columns: Hello, NoAnswer, Check, Checked, Home, Rollout, AtRest, Homed, TimeUp, LimitLeft, Stop,
/// Stands, BrakeFault, ZeroFault, CountDoubted.
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
        // Homing: the arm is slow here, and off is a stop.
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
         rest(S::Settling), STOP, rest(S::Settling), FAIL, LATCH, LATCH],
        // Running
        [no(S::Running), LATCH, no(S::Running), rest(S::Running), no(S::Running), no(S::Running),
         rest(S::Running), rest(S::Running), STOP, STOP, STOP, rest(S::Running), FAIL, LATCH, FAIL],
        // Braking: it is being stopped already, and what it came to stands.
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

/// The table as a Mermaid state diagram: SAFETY.md shows it, and a test compares.
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
            // The amplifier goes on by an order of the operator alone, and off by the action Off.
            if !state.is_powered() && next.is_powered() {
                assert!(matches!(event, E::Check | E::Home | E::Rollout), "{step}");
            }
            if state.is_powered() && !next.is_powered() {
                assert_eq!(action, A::Off, "{step}");
            }
            // A fault leads to the latch, or to the brake before it, from everywhere.
            if event == E::ZeroFault {
                assert_eq!(next, S::Faulted, "{step}");
            }
            if event == E::BrakeFault {
                let stops = matches!(next, S::Faulted | S::Faulting | S::Braking);
                assert!(stops && action != A::RunPolicy, "{step}");
            }
            // A doubted count is damped where the arm may be fast, and switches off everywhere else.
            if event == E::CountDoubted {
                let damps = matches!(state, S::Running | S::Braking | S::Faulting);
                assert_eq!(next, if damps { S::Faulting } else { S::Faulted }, "{step}");
            }
            // The latch gives way to a hello alone, and then nothing moves before 1 s at rest.
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
            // The policy gets the motor after homing and settling, and from nowhere else.
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
            // A stop is heard wherever the motor may turn fast.
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
