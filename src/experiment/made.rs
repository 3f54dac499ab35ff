/// Whether this process made a result. A result of several parts is [`Self::Now`] if any part is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Made {
    /// Before this process began: the result was on disk.
    Earlier,
    /// Since this process began: a policy was trained for it, or a rollout recorded.
    Now,
}

impl Made {
    /// [`Self::Now`] if the condition holds.
    pub(super) fn now_if(condition: bool) -> Self {
        if condition { Self::Now } else { Self::Earlier }
    }
}
