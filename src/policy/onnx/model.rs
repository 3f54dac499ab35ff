//! The parts of an ONNX model that a policy has: nodes, constants, input and outputs.

use std::collections::HashMap;

use super::protobuf::{Fields, Malformed, Value, floats};
use super::{ImportError, MAX_FILE_BYTES, MAX_OPERATORS};

/// ONNX's numbers for the types of a tensor's elements: `float`, `int64` and `double`.
const FLOAT: i64 = 1;
const INT64: i64 = 7;
const DOUBLE: i64 = 11;

/// A graph of operators.
#[derive(Debug, Default)]
pub struct Graph<'a> {
    pub nodes: Vec<Node<'a>>,
    /// Constants by name.
    pub constants: HashMap<&'a str, Tensor>,
    pub inputs: Vec<&'a str>,
    pub outputs: Vec<&'a str>,
}

/// An operator with the names of its inputs and outputs.
#[derive(Debug, Default)]
pub struct Node<'a> {
    pub operator: &'a str,
    pub inputs: Vec<&'a str>,
    pub outputs: Vec<&'a str>,
    integers: HashMap<&'a str, i64>,
    numbers: HashMap<&'a str, f32>,
    value: Option<Tensor>,
}

/// A constant. Its values are in single precision; a constant that is neither `float` nor `double`
/// has a shape but no values.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Tensor {
    pub shape: Vec<usize>,
    pub values: Vec<f32>,
}

/// Returns the text of an entry in a model's metadata; `None` if the model has no entry of this
/// name, or the entry has no text.
pub fn entry<'a>(bytes: &'a [u8], key: &str) -> Result<Option<&'a str>, Malformed> {
    for field in Fields::of(bytes) {
        let (14, value) = field? else { continue };
        let entry = value.bytes()?;
        if name_of(entry)? == key {
            let texts = Fields::of(entry).filter_map(Result::ok).filter(|(field, _)| *field == 2);
            return texts.last().map(|(_, text)| text.text()).transpose();
        }
    }
    Ok(None)
}

impl<'a> Graph<'a> {
    /// Reads the graph of a model's file.
    pub fn read(bytes: &'a [u8]) -> Result<Self, ImportError> {
        if bytes.len() as u64 > MAX_FILE_BYTES {
            return Err(ImportError::TooLarge);
        }
        let mut graph = None;
        for field in Fields::of(bytes) {
            if let (7, value) = field? {
                graph = Some(value.bytes()?);
            }
        }
        let mut read = Self::default();
        for field in Fields::of(graph.ok_or(ImportError::NotOnnx)?) {
            match field? {
                (1, _) if read.nodes.len() == MAX_OPERATORS => {
                    return Err(ImportError::TooManyOperators);
                }
                (1, value) => read.nodes.push(Node::read(value.bytes()?)?),
                (5, value) => {
                    let (name, tensor) = tensor(value.bytes()?)?;
                    read.constants.insert(name, tensor);
                }
                (11, value) => read.inputs.push(name_of(value.bytes()?)?),
                (12, value) => read.outputs.push(name_of(value.bytes()?)?),
                _ => {}
            }
        }
        for node in &mut read.nodes {
            if let (Some(value), [output]) = (node.value.take(), node.outputs.as_slice()) {
                read.constants.insert(output, value);
            }
        }
        // Older files list their constants among the inputs.
        let Self { inputs, constants, .. } = &mut read;
        inputs.retain(|input| !constants.contains_key(input));
        Ok(read)
    }

    /// Returns the constant that this name stands for, directly or through `Identity` and casts
    /// to floating-point numbers.
    pub fn constant(&self, name: &str) -> Option<&Tensor> {
        let mut name = name;
        for _ in 0..=self.nodes.len() {
            if let Some(tensor) = self.constants.get(name) {
                return Some(tensor);
            }
            let node = self.maker(name)?;
            if node.operator != "Identity" && !node.is_cast_to_float() {
                return None;
            }
            name = node.inputs.first()?;
        }
        None
    }

    /// Returns the operator whose output has this name.
    pub fn maker(&self, name: &str) -> Option<&Node<'a>> {
        self.nodes.iter().find(|node| node.outputs.contains(&name))
    }
}

impl<'a> Node<'a> {
    /// Whether the operator is a `Cast` to single or double precision, which are the types 1 and 11.
    pub fn is_cast_to_float(&self) -> bool {
        self.operator == "Cast" && matches!(self.integer("to", 0), 1 | 11)
    }

    fn read(bytes: &'a [u8]) -> Result<Self, ImportError> {
        let mut node = Self::default();
        for field in Fields::of(bytes) {
            match field? {
                (1, value) => node.inputs.push(value.text()?),
                (2, value) => node.outputs.push(value.text()?),
                (4, value) => node.operator = value.text()?,
                (5, value) => node.attribute(value.bytes()?)?,
                _ => {}
            }
        }
        Ok(node)
    }

    fn attribute(&mut self, bytes: &'a [u8]) -> Result<(), ImportError> {
        let name = name_of(bytes)?;
        for field in Fields::of(bytes) {
            match field? {
                (2, Value::Fixed32(number)) => {
                    self.numbers.insert(name, f32::from_le_bytes(number));
                }
                (3, value) => {
                    self.integers.insert(name, value.integer()?);
                }
                (5, value) if name == "value" => self.value = Some(tensor(value.bytes()?)?.1),
                _ => {}
            }
        }
        Ok(())
    }

    /// Returns the integer attribute of this name, or `default` without one.
    pub fn integer(&self, name: &str, default: i64) -> i64 {
        self.integers.get(name).copied().unwrap_or(default)
    }

    /// Returns the floating-point attribute of this name, or `default` without one.
    pub fn number(&self, name: &str, default: f32) -> f32 {
        self.numbers.get(name).copied().unwrap_or(default)
    }
}

/// Returns the text of field 1 of a message: in several of ONNX's messages, the name.
fn name_of(bytes: &[u8]) -> Result<&str, Malformed> {
    let mut name = "";
    for field in Fields::of(bytes) {
        if let (1, value) = field? {
            name = value.text()?;
        }
    }
    Ok(name)
}

/// Reads a tensor and its name.
fn tensor(bytes: &[u8]) -> Result<(&str, Tensor), ImportError> {
    let (mut name, mut kind, mut is_outside) = ("", 0, false);
    let (mut shape, mut values, mut raw) = (Vec::new(), Vec::new(), None);
    for field in Fields::of(bytes) {
        match field? {
            (1, value) => shape.extend(value.integers()?),
            (2, value) => kind = value.integer()?,
            (4, value) => values.extend(value.floats()?),
            (8, value) => name = value.text()?,
            (9, value) => raw = Some(value.bytes()?),
            (10, value) => values.extend(doubles(value.bytes()?)?),
            (14, value) => is_outside = value.integer()? == 1,
            _ => {}
        }
    }
    if is_outside {
        return Err(ImportError::OtherFile { name: name.to_owned() });
    }
    match (kind, raw) {
        (FLOAT, Some(raw)) => values = floats(raw)?,
        (DOUBLE, Some(raw)) => values = doubles(raw)?,
        _ => {}
    }
    let shape = shape.into_iter().map(|size| usize::try_from(size).map_err(|_| Malformed));
    let shape = shape.collect::<Result<Vec<_>, _>>()?;
    let count = shape.iter().try_fold(1_usize, |count, &size| count.checked_mul(size));
    if matches!(kind, FLOAT | DOUBLE) && count != Some(values.len()) {
        return Err(ImportError::Values { name: name.to_owned() });
    }
    if !matches!(kind, FLOAT | DOUBLE | INT64) {
        values.clear();
    }
    Ok((name, Tensor { shape, values }))
}

fn doubles(bytes: &[u8]) -> Result<Vec<f32>, Malformed> {
    let (numbers, []) = bytes.as_chunks() else { return Err(Malformed) };
    Ok(numbers.iter().map(|number| f64::from_le_bytes(*number) as f32).collect())
}
