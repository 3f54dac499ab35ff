use crate::qube::Quantity;

/// Number of coordinates of a particle within a belief: one for each quantity, and one for each
/// fraction of a voltage, positive or negative, that arrives at the motor.
pub(super) const NUMBERS: usize = Quantity::COUNT + 2;

/// Index of the coordinate for the fraction of a positive voltage that arrives at the motor.
pub(super) const POSITIVE_SHARE: usize = NUMBERS - 2;

/// Index of the coordinate for the fraction of a negative voltage that arrives at the motor.
pub(super) const NEGATIVE_SHARE: usize = NUMBERS - 1;

/// Coordinates of half of the particles, in percent of the way from the middle of a belief to its
/// upper end (100) or its lower end (-100). The other half are their mirror images, in which
/// positive and negative directions are exchanged. The particles that are hardest to brake come
/// first: a heavy Qube with a weak motor.
///
/// The first coordinates have the order of [`Quantity::all`]: the nine parameters, Coulomb
/// friction, the dead zones of positive and negative voltages, the cable's stiffness and rest
/// angle, and the delay. The fractions of positive and negative voltages that arrive follow.
///
/// Searches for policies that throw the arm against its stop find only Qubes with weak motors,
/// because a strong motor compensates for the uncertainty. The table therefore has all 16 corners
/// of masses and lengths with a weak motor and the longest delay. Eight of the corners appear again
/// with the shortest delay, and eight with a strong motor. The friction of the joints, which only
/// helps the brake, is at its lower end throughout. The fractions of the voltages that arrive are
/// at their upper end throughout; `Belief::weak_side` lowers one of them in the first row.
#[rustfmt::skip]
pub(super) const PLACES: [[i8; NUMBERS]; 32] = [
    [   0,  100, -100, -100, -100,  100,  100,  100,  100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100,  100,  100,  100,  100, -100,  100,  100, -100,   50, -100,  100,  100],
    [   0,  100, -100, -100, -100, -100,  100,  100,  100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100,  100, -100,  100,  100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100,  100,  100, -100,  100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100,  100,  100,  100, -100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100, -100, -100,  100,  100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100, -100,  100, -100,  100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100, -100,  100,  100, -100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100, -100, -100,  100,  100, -100,  100,  100, -100,   50, -100,  100,  100],
    [   0,  100, -100, -100, -100, -100,  100, -100,  100, -100, -100, -100,  100,   50, -100,  100,  100],
    [   0,  100, -100, -100, -100, -100,  100,  100, -100, -100, -100, -100,  100,   50, -100,  100,  100],
    [   0,  100, -100, -100, -100,  100, -100, -100,  100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100,  100, -100,  100, -100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100,  100,  100, -100, -100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100,  100, -100, -100,  100, -100, -100, -100,  100,   50, -100,  100,  100],
    [   0,  100, -100, -100, -100,  100, -100,  100, -100, -100, -100, -100,  100,   50, -100,  100,  100],
    [   0,  100, -100, -100, -100,  100,  100, -100, -100, -100,  100,  100, -100,   50, -100,  100,  100],
    [   0,  100, -100, -100, -100, -100, -100, -100,  100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100, -100, -100,  100, -100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100, -100,  100, -100, -100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100,  100, -100, -100, -100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100, -100, -100, -100, -100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0,  100, -100, -100, -100, -100, -100, -100, -100, -100,  100,  100, -100,   50, -100,  100,  100],
    [   0, -100,  100, -100, -100,  100,  100,  100,  100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0, -100,  100, -100, -100, -100, -100,  100,  100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0, -100,  100, -100, -100, -100,  100, -100,  100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0, -100,  100, -100, -100, -100,  100,  100, -100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0, -100,  100, -100, -100,  100, -100, -100,  100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0, -100,  100, -100, -100,  100, -100,  100, -100, -100, -100, -100,  100,   50,  100,  100,  100],
    [   0, -100,  100, -100, -100,  100,  100, -100, -100, -100,  100,  100, -100,   50,  100,  100,  100],
    [   0, -100,  100, -100, -100, -100, -100, -100, -100, -100,  100,  100, -100,   50,  100,  100,  100],
];
