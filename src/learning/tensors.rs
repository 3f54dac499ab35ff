//! Tensors of one dimension as safetensors: what checkpoints and results of trainings are made of.

use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensorError, SafeTensors};
use thiserror::Error;

/// A tensor to be written.
pub(super) struct Tensor {
    /// Name in the file.
    pub name: &'static str,
    dtype: Dtype,
    /// The values, little-endian.
    pub bytes: Vec<u8>,
}

impl Tensor {
    /// A tensor of these values.
    pub fn of_f32s(name: &'static str, values: impl IntoIterator<Item = f32>) -> Self {
        let bytes = values.into_iter().flat_map(f32::to_le_bytes).collect();
        Self { name, dtype: Dtype::F32, bytes }
    }

    /// A tensor of these values.
    pub fn of_f64s(name: &'static str, values: impl IntoIterator<Item = f64>) -> Self {
        let bytes = values.into_iter().flat_map(f64::to_le_bytes).collect();
        Self { name, dtype: Dtype::F64, bytes }
    }

    /// A tensor of these values.
    pub fn of_u64s(name: &'static str, values: impl IntoIterator<Item = u64>) -> Self {
        let bytes = values.into_iter().flat_map(u64::to_le_bytes).collect();
        Self { name, dtype: Dtype::U64, bytes }
    }
}

/// A defect of the tensors in a file.
#[derive(Debug, Error)]
pub enum TensorDefect {
    /// The bytes are not safetensors, or a tensor is missing.
    #[error(transparent)]
    File(#[from] SafeTensorError),
    /// A tensor has values of another type.
    #[error("{name} is of type {dtype:?}")]
    Type {
        /// Name of the tensor.
        name: String,
        /// Type of its values.
        dtype: Dtype,
    },
    /// A tensor has another number of values.
    #[error("{name} has {values} values instead of {expected}")]
    Count {
        /// Name of the tensor.
        name: String,
        /// Number of its values.
        values: usize,
        /// Number of values that it must have.
        expected: usize,
    },
}

/// The tensors with their names, as safetensors writes them.
pub(super) fn tensor_views(
    tensors: &[Tensor],
) -> Result<Vec<(&'static str, TensorView<'_>)>, SafeTensorError> {
    let views = tensors.iter().map(|tensor| {
        let count = tensor.bytes.len() * 8 / tensor.dtype.bitsize();
        Ok((tensor.name, TensorView::new(tensor.dtype, vec![count], &tensor.bytes)?))
    });
    views.collect()
}

/// The values of a tensor of `f32`.
pub(super) fn f32s<'a>(
    tensors: &'a SafeTensors<'_>,
    name: &str,
) -> Result<impl ExactSizeIterator<Item = f32> + use<'a>, TensorDefect> {
    let (values, _) = bytes(tensors, name, Dtype::F32)?.as_chunks::<4>();
    Ok(values.iter().map(|bytes| f32::from_le_bytes(*bytes)))
}

/// The values of a tensor of `f64`.
pub(super) fn f64s(tensors: &SafeTensors<'_>, name: &str) -> Result<Vec<f64>, TensorDefect> {
    let (values, _) = bytes(tensors, name, Dtype::F64)?.as_chunks::<8>();
    Ok(values.iter().map(|bytes| f64::from_le_bytes(*bytes)).collect())
}

/// The values of a tensor of `u64`.
pub(super) fn u64s(tensors: &SafeTensors<'_>, name: &str) -> Result<Vec<u64>, TensorDefect> {
    let (values, _) = bytes(tensors, name, Dtype::U64)?.as_chunks::<8>();
    Ok(values.iter().map(|bytes| u64::from_le_bytes(*bytes)).collect())
}

/// The two values of a tensor that must have two.
pub(super) fn pair<T>(name: &str, values: Vec<T>) -> Result<[T; 2], TensorDefect> {
    <[T; 2]>::try_from(values).map_err(|values| TensorDefect::Count {
        name: name.to_owned(),
        values: values.len(),
        expected: 2,
    })
}

fn bytes<'a>(
    tensors: &'a SafeTensors<'_>,
    name: &str,
    dtype: Dtype,
) -> Result<&'a [u8], TensorDefect> {
    let tensor = tensors.tensor(name)?;
    if tensor.dtype() == dtype {
        Ok(tensor.data())
    } else {
        Err(TensorDefect::Type { name: name.to_owned(), dtype: tensor.dtype() })
    }
}
