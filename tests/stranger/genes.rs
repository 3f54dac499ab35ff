use qube_hil::elementary::normal_pair;
use rand::{Rng, RngExt};

/// A reader of genes, one after the other. Each gene is about normally distributed; genes beyond
/// the last are zero.
pub struct Genes<'a> {
    rest: std::slice::Iter<'a, f64>,
    read: usize,
}

impl<'a> Genes<'a> {
    /// Begins at the first gene.
    pub fn new(genes: &'a [f64]) -> Self {
        Self { rest: genes.iter(), read: 0 }
    }

    /// The next gene, unscaled.
    pub fn normal(&mut self) -> f64 {
        self.read += 1;
        self.rest.next().copied().unwrap_or(0.0)
    }

    /// The next gene as a number from 0 to 1; one in three is at one of the ends.
    pub fn unit(&mut self) -> f64 {
        (0.5 + 0.5 * self.normal()).clamp(0.0, 1.0)
    }

    /// The next gene as a number from -1 to 1.
    pub fn signed(&mut self) -> f64 {
        self.normal().clamp(-1.0, 1.0)
    }

    /// The next gene as a whole number from `low` to `high`.
    pub fn whole(&mut self, low: u32, high: u32) -> u32 {
        low + (self.unit() * f64::from(high - low)).round() as u32
    }

    /// Number of genes read.
    pub fn read(&self) -> usize {
        self.read
    }
}

/// A normally distributed number, with the same bits on every machine.
pub fn normal(random: &mut impl Rng) -> f64 {
    normal_pair([random.random(), random.random()])[0]
}
