use super::{Dynamics, NonidealDynamics, State};

/// Number of Qubes that are computed side by side as one block: the single-precision numbers in the
/// widest vector register (512 bits). Each has a lane, an index from 0 to 15.
pub const BLOCK: usize = 16;

/// One quantity of the sixteen Qubes of a block, one number a lane.
pub type Lanes = [f32; BLOCK];

/// A structure of arrays that holds one item a lane: each number of the items is an array over the
/// lanes.
pub trait InLanes {
    /// Type of the item in one lane.
    type One;

    /// Fills every lane with the same item.
    fn all(one: &Self::One) -> Self;

    /// Reads the item in one lane.
    fn lane(&self, lane: usize) -> Self::One;

    /// Writes an item into one lane.
    fn set_lane(&mut self, lane: usize, one: &Self::One);
}

impl InLanes for Lanes {
    type One = f32;

    #[inline(always)]
    fn all(one: &f32) -> Self {
        [*one; BLOCK]
    }

    #[inline(always)]
    fn lane(&self, lane: usize) -> f32 {
        self[lane]
    }

    #[inline(always)]
    fn set_lane(&mut self, lane: usize, one: &f32) {
        self[lane] = *one;
    }
}

macro_rules! in_lanes {
    ($name:ident { $($field:ident),* $(,)? }) => {
        impl InLanes for $name<Lanes> {
            type One = $name<f32>;

            #[inline(always)]
            fn all(one: &$name<f32>) -> Self {
                $name { $($field: InLanes::all(&one.$field)),* }
            }

            #[inline(always)]
            fn lane(&self, lane: usize) -> $name<f32> {
                $name { $($field: self.$field.lane(lane)),* }
            }

            #[inline(always)]
            fn set_lane(&mut self, lane: usize, one: &$name<f32>) {
                $(self.$field.set_lane(lane, &one.$field);)*
            }
        }
    };
}

in_lanes!(State { theta, alpha, theta_dot, alpha_dot });

in_lanes!(Dynamics {
    arm_inertia,
    quarter_inertia,
    coupling,
    pendulum_inertia,
    gravity_torque,
    torque_per_volt,
    arm_damping,
    pendulum_damping,
});

in_lanes!(NonidealDynamics {
    ideal,
    coulomb_torque,
    positive_dead_zone,
    negative_dead_zone,
    cable_stiffness,
    cable_rest,
});
