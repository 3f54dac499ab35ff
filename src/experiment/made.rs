/// Time at which a result was made. A result of several parts is [`Self::Now`] if any part is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Made {
    /// The result was on disk before this process began.
    Earlier,
    /// This process trained a policy or recorded a rollout for the result.
    Now,
}

impl Made {
    /// [`Self::Now`] if the condition holds.
    pub(super) fn now_if(condition: bool) -> Self {
        if condition { Self::Now } else { Self::Earlier }
    }
}
