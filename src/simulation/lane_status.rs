/// State of a lane's trajectory after a step.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(u8)]
pub enum LaneStatus {
    /// The trajectory continues.
    #[default]
    Running,
    /// The state has left the safety box: the trajectory earns nothing more, and the value of its final
    /// state is 0.
    LeftBox,
    /// The trajectory has its 600 steps; a learner bootstraps the value of its final state.
    TimeUp,
}
