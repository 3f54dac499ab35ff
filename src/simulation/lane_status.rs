/// State of a lane's trajectory after a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum LaneStatus {
    /// The trajectory continues.
    #[default]
    Running,
    /// The state has left the safety box, which ends the trajectory: it earns no further reward,
    /// and the value of its final state is 0.
    LeftBox,
    /// The trajectory ended after 600 steps; a learner estimates the value of its final state
    /// (bootstrapping).
    TimeUp,
}
