use crate::device::LinkFault;
use crate::telemetry::Fault;

/// The reason why a device gives no samples until it has answered a new hello.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DeviceLoss {
    /// The port is gone.
    LinkGone,
    /// The board or its Qube has restarted.
    BoardRestarted,
    /// The board has reported that its Qube does not answer.
    QubeOff,
}

impl DeviceLoss {
    /// All reasons.
    pub const ALL: [Self; 3] = [Self::LinkGone, Self::BoardRestarted, Self::QubeOff];

    /// The loss that a failed exchange shows; `None` if a later exchange may succeed.
    #[must_use]
    pub fn of(fault: LinkFault) -> Option<Self> {
        match fault {
            LinkFault::Gone => Some(Self::LinkGone),
            LinkFault::Restarted => Some(Self::BoardRestarted),
            LinkFault::QubeOff => Some(Self::QubeOff),
            LinkFault::Timeout
            | LinkFault::Full
            | LinkFault::NotArmed
            | LinkFault::WatchdogTripped
            | LinkFault::StaleSample => None,
        }
    }

    /// The fault that ends a motion after this loss.
    #[must_use]
    pub fn fault(self) -> Fault {
        match self {
            Self::LinkGone => Fault::LinkGone,
            Self::BoardRestarted => Fault::BoardRestarted,
            Self::QubeOff => Fault::QubeOff,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_failure_that_waiting_does_not_cure_is_a_loss() {
        let lost = [LinkFault::Gone, LinkFault::Restarted, LinkFault::QubeOff];
        assert_eq!(lost.map(DeviceLoss::of), DeviceLoss::ALL.map(Some));
        let passing = [
            LinkFault::Timeout,
            LinkFault::Full,
            LinkFault::NotArmed,
            LinkFault::WatchdogTripped,
            LinkFault::StaleSample,
        ];
        assert_eq!(passing.map(DeviceLoss::of), [None; 5]);
    }
}
