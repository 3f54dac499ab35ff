use nalgebra::{DMatrix, DMatrixViewMut, DVector};

/// The Cholesky factorisation `K = L L^T` of an n x n covariance matrix. It keeps `L^-1`, so that
/// every solve is a matrix product.
///
/// The factorisation splits the matrix into halves recursively, because large matrix products run
/// several times faster than elimination column by column; blocks of up to [`LEAF`] rows are
/// eliminated column by column.
#[derive(Clone, Debug)]
pub(super) struct Factor {
    /// `L^-1`, n x n, lower triangular; zeros above.
    inverse: DMatrix<f64>,
    /// `log |K|`.
    log_determinant: f64,
    /// Number that was added to the diagonal to make the matrix positive definite; 0 if none was
    /// needed.
    jitter: f64,
}

/// Size up to which a block is eliminated column by column.
const LEAF: usize = 32;
/// Number of rows of `K^-1` that one matrix product computes.
const BLOCK: usize = 64;
/// Jitters that are tried in this order until the factorisation succeeds, as fractions of the
/// `scale` that [`Factor::new`] is given.
const JITTERS: [f64; 5] = [0.0, 1e-10, 1e-8, 1e-6, 1e-4];

/// Largest jitter, as a fraction of the scale.
pub(super) const LARGEST_JITTER: f64 = JITTERS[JITTERS.len() - 1];

impl Factor {
    /// Factors a symmetric matrix given by its lower triangle. If the matrix is not positive
    /// definite, a jitter of up to [`LARGEST_JITTER`] times `scale` is added to its diagonal;
    /// `None` if the largest jitter does not suffice.
    pub(super) fn new(matrix: &DMatrix<f64>, scale: f64) -> Option<Self> {
        JITTERS.iter().find_map(|jitter| Self::with_jitter(matrix, jitter * scale))
    }

    fn with_jitter(matrix: &DMatrix<f64>, jitter: f64) -> Option<Self> {
        let n = matrix.nrows();
        let mut lower = matrix.clone();
        for i in 0..n {
            lower[(i, i)] += jitter;
        }
        let mut inverse = DMatrix::zeros(n, n);
        if !factor(&mut lower.as_view_mut(), &mut inverse.as_view_mut()) {
            return None;
        }
        let log_determinant = -2.0 * (0..n).map(|i| inverse[(i, i)].ln()).sum::<f64>();
        log_determinant.is_finite().then_some(Self { inverse, log_determinant, jitter })
    }

    pub(super) fn log_determinant(&self) -> f64 {
        self.log_determinant
    }

    pub(super) fn jitter(&self) -> f64 {
        self.jitter
    }

    /// `L^-1 v`.
    pub(super) fn whiten(&self, v: &[f64]) -> DVector<f64> {
        let n = v.len();
        let mut out = DVector::zeros(n);
        let slice = out.as_mut_slice();
        for (j, &v) in v.iter().enumerate() {
            let column = &self.inverse.as_slice()[j * n + j..(j + 1) * n];
            for (out, l) in slice[j..].iter_mut().zip(column) {
                *out += v * l;
            }
        }
        out
    }

    /// `L^-T v`.
    pub(super) fn whiten_transposed(&self, v: &[f64]) -> DVector<f64> {
        let n = v.len();
        DVector::from_iterator(
            n,
            (0..n).map(|j| dot(&self.inverse.as_slice()[j * n + j..(j + 1) * n], &v[j..])),
        )
    }

    /// `K^-1 v`.
    pub(super) fn solve(&self, v: &[f64]) -> DVector<f64> {
        self.whiten_transposed(self.whiten(v).as_slice())
    }

    /// The lower triangle of `K^-1 = L^-T L^-1`; entries above it are undefined.
    pub(super) fn inverse(&self) -> DMatrix<f64> {
        let n = self.inverse.nrows();
        let mut out = DMatrix::zeros(n, n);
        if n <= BLOCK {
            for j in 0..n {
                for i in j..n {
                    let column = |c: usize| &self.inverse.as_slice()[c * n + i..(c + 1) * n];
                    out[(i, j)] = dot(column(i), column(j));
                }
            }
            return out;
        }
        for first in (0..n).step_by(BLOCK) {
            let size = BLOCK.min(n - first);
            // In these columns the rows above `first` are zero.
            let left = self.inverse.view((first, first), (n - first, size)).transpose();
            let right = self.inverse.view((first, 0), (n - first, first + size));
            out.view_mut((first, 0), (size, first + size)).gemm(1.0, &left, &right, 0.0);
        }
        out
    }
}

/// Overwrites the lower triangle of `inverse` by `L^-1` and reports whether `a` is positive
/// definite. The lower triangle of `a` is used as working memory.
fn factor(a: &mut DMatrixViewMut<f64>, inverse: &mut DMatrixViewMut<f64>) -> bool {
    let n = a.nrows();
    if n <= LEAF {
        return factor_leaf(a, inverse);
    }
    let h = (n / 2).next_multiple_of(8).min(n - 1);
    let rest = n - h;
    if !factor(&mut a.view_mut((0, 0), (h, h)), &mut inverse.view_mut((0, 0), (h, h))) {
        return false;
    }
    let inverse_11 = inverse.view((0, 0), (h, h)).into_owned();
    let l_21 = a.view((h, 0), (rest, h)) * inverse_11.transpose();
    a.view_mut((h, h), (rest, rest)).gemm(-1.0, &l_21, &l_21.transpose(), 1.0);
    if !factor(&mut a.view_mut((h, h), (rest, rest)), &mut inverse.view_mut((h, h), (rest, rest))) {
        return false;
    }
    let inverse_22 = inverse.view((h, h), (rest, rest)).into_owned();
    let coupling = l_21 * inverse_11;
    inverse.view_mut((h, 0), (rest, h)).gemm(-1.0, &inverse_22, &coupling, 0.0);
    true
}

fn factor_leaf(a: &mut DMatrixViewMut<f64>, inverse: &mut DMatrixViewMut<f64>) -> bool {
    let n = a.nrows();
    let mut l = [0.0; LEAF * LEAF];
    let l = &mut l[..n * n];
    for j in 0..n {
        for i in j..n {
            l[j * n + i] = a[(i, j)];
        }
    }
    for j in 0..n {
        let (column, later) = l[j * n..].split_at_mut(n);
        let pivot = column[j];
        // The comparison also rejects a pivot that is NaN.
        if !(pivot > 0.0 && pivot.is_finite()) {
            return false;
        }
        let scale = 1.0 / pivot.sqrt();
        column[j..].iter_mut().for_each(|x| *x *= scale);
        for k in j + 1..n {
            let factor = column[k];
            let target = &mut later[(k - j - 1) * n + k..(k - j) * n];
            for (t, c) in target.iter_mut().zip(&column[k..]) {
                *t -= factor * c;
            }
        }
    }
    let mut solution = [0.0; LEAF];
    for j in 0..n {
        let x = &mut solution[..n];
        x.fill(0.0);
        x[j] = 1.0;
        for k in j..n {
            let (done, below) = x.split_at_mut(k + 1);
            done[k] /= l[k * n + k];
            for (b, l) in below.iter_mut().zip(&l[k * n + k + 1..(k + 1) * n]) {
                *b -= done[k] * l;
            }
        }
        for i in j..n {
            inverse[(i, j)] = x[i];
            a[(i, j)] = l[j * n + i];
        }
    }
    true
}

/// The scalar product of two slices of equal length. Eight partial sums let the compiler use vector
/// registers.
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a_chunks, b_chunks) = (a.chunks_exact(8), b.chunks_exact(8));
    let rest: f64 = a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(a, b)| a * b).sum();
    let mut lanes = [0.0; 8];
    for (a, b) in a_chunks.zip(b_chunks) {
        for lane in 0..8 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    lanes.iter().sum::<f64>() + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A well-conditioned covariance-like matrix.
    fn matrix(n: usize) -> DMatrix<f64> {
        DMatrix::from_fn(n, n, |i, j| {
            let distance = (i as f64 * 0.7).sin() - (j as f64 * 0.7).sin();
            (-distance * distance).exp() + if i == j { 0.1 } else { 0.0 }
        })
    }

    #[test]
    fn the_factorisation_agrees_with_a_general_solver() {
        for n in [1, 2, 25, 32, 33, 100, 257] {
            let k = matrix(n);
            let factor = Factor::new(&k, 1.0).unwrap();
            assert_eq!(factor.jitter(), 0.0);
            let v = DVector::from_fn(n, |i, _| (i as f64).cos());
            let residual = &k * factor.solve(v.as_slice()) - &v;
            assert!(residual.amax() < 1e-11, "{n}: {}", residual.amax());
            let lower = factor.inverse().lower_triangle();
            let whole = &lower + lower.transpose() - DMatrix::from_diagonal(&lower.diagonal());
            assert!((whole * &k - DMatrix::identity(n, n)).amax() < 1e-10);
            let log_determinant = 2.0 * k.cholesky().unwrap().l().diagonal().map(f64::ln).sum();
            assert!((factor.log_determinant() - log_determinant).abs() < 1e-9);
        }
    }

    #[test]
    fn a_singular_matrix_gets_jitter_and_an_indefinite_one_fails() {
        let factor = Factor::new(&DMatrix::from_element(40, 40, 1.0), 1.0).unwrap();
        assert!(factor.jitter() > 0.0 && factor.jitter() <= 1e-6);
        let mut indefinite = DMatrix::identity(40, 40);
        indefinite[(35, 35)] = -1.0;
        assert!(Factor::new(&indefinite, 1.0).is_none());
        indefinite[(35, 35)] = f64::NAN;
        assert!(Factor::new(&indefinite, 1.0).is_none());
    }
}
