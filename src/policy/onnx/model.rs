//! The parts of an ONNX model that a policy has: nodes, constants, input and outputs.

use std::borrow::Cow;
use std::collections::{HashMap, HashSet};

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
    pub inputs: Vec<Input<'a>>,
    pub outputs: Vec<&'a str>,
}

/// An input of a graph.
#[derive(Debug)]
pub struct Input<'a> {
    pub name: &'a str,
    /// Number of entries of one observation in the declared shape; `None` if the file does not
    /// declare it.
    pub entries: Option<usize>,
}

/// An operator with the names of its inputs and outputs.
#[derive(Debug, Default)]
pub struct Node<'a> {
    /// Name of an operator of ONNX; other text for every other operator.
    pub operator: Cow<'a, str>,
    pub inputs: Vec<&'a str>,
    pub outputs: Vec<&'a str>,
    integers: HashMap<&'a str, i64>,
    numbers: HashMap<&'a str, f32>,
    lists: HashMap<&'a str, Vec<i64>>,
    number_lists: HashMap<&'a str, Vec<f32>>,
    value: Option<Tensor>,
}

/// A constant with the values of its type.
#[derive(Clone, Debug, PartialEq)]
pub struct Tensor {
    pub shape: Vec<usize>,
    pub values: Values,
}

/// The values of a constant.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    /// Values of the types `float` and `double`, in single precision.
    Numbers(Vec<f32>),
    /// Values of the type `int64`.
    Integers(Vec<i64>),
    /// Values of another type, which are not read.
    Unread,
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
        // Names of functions that the model defines in place of ONNX's own operators.
        let (mut graph, mut defined) = (None, HashSet::new());
        for field in Fields::of(bytes) {
            match field? {
                (7, value) => graph = Some(value.bytes()?),
                (25, value) => {
                    let function = value.bytes()?;
                    if is_of_onnx(text_of(function, 10)?) {
                        defined.insert(name_of(function)?);
                    }
                }
                _ => {}
            }
        }
        let mut read = Self::default();
        for field in Fields::of(graph.ok_or(ImportError::NotOnnx)?) {
            match field? {
                (1, _) if read.nodes.len() == MAX_OPERATORS => {
                    return Err(ImportError::TooManyOperators);
                }
                (1, value) => read.nodes.push(Node::read(value.bytes()?, &defined)?),
                (5, value) => {
                    let (name, tensor) = tensor(value.bytes()?)?;
                    read.constants.insert(name, tensor);
                }
                (11, value) => read.inputs.push(Input::read(value.bytes()?)?),
                (12, value) => read.outputs.push(name_of(value.bytes()?)?),
                _ => {}
            }
        }
        for node in &mut read.nodes {
            if let (Some(value), [output]) = (node.constant(), node.outputs.as_slice()) {
                read.constants.insert(output, value);
            }
        }
        // Older files list their constants among the inputs.
        let Self { inputs, constants, .. } = &mut read;
        inputs.retain(|input| !constants.contains_key(input.name));
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
    /// Returns whether the operator is a `Cast` to single or double precision, which are the types
    /// 1 and 11.
    pub fn is_cast_to_float(&self) -> bool {
        self.operator == "Cast" && matches!(self.integer("to", 0), 1 | 11)
    }

    fn read(bytes: &'a [u8], defined: &HashSet<&str>) -> Result<Self, ImportError> {
        let mut node = Self::default();
        let (mut operator, mut domain) = ("", "");
        for field in Fields::of(bytes) {
            match field? {
                (1, value) => node.inputs.push(value.text()?),
                (2, value) => node.outputs.push(value.text()?),
                (4, value) => operator = value.text()?,
                (5, value) => node.attribute(value.bytes()?)?,
                (7, value) => domain = value.text()?,
                _ => {}
            }
        }
        node.operator = if !is_of_onnx(domain) {
            format!("{domain}::{operator}").into()
        } else if defined.contains(operator) {
            format!("{operator} as a function of its own").into()
        } else {
            operator.into()
        };
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
                (7, value) => {
                    self.number_lists.entry(name).or_default().extend(value.floats()?);
                }
                (8, value) => self.lists.entry(name).or_default().extend(value.integers()?),
                _ => {}
            }
        }
        Ok(())
    }

    /// Takes the value of an operator that makes a constant; `None` for every other operator, and
    /// if no attribute gives a value.
    fn constant(&mut self) -> Option<Tensor> {
        if !matches!(&*self.operator, "Constant" | "ConstantOfShape") {
            return None;
        }
        let one = |values| Tensor { shape: Vec::new(), values };
        let several = |count, values| Tensor { shape: vec![count], values };
        let number = self.numbers.get("value_float");
        let integer = self.integers.get("value_int");
        let (numbers, integers) =
            (self.number_lists.remove("value_floats"), self.lists.remove("value_ints"));
        self.value
            .take()
            .or_else(|| number.map(|&it| one(Values::Numbers(vec![it]))))
            .or_else(|| integer.map(|&it| one(Values::Integers(vec![it]))))
            .or_else(|| numbers.map(|it| several(it.len(), Values::Numbers(it))))
            .or_else(|| integers.map(|it| several(it.len(), Values::Integers(it))))
    }

    /// Returns the integer attribute of this name, or `default` without one.
    pub fn integer(&self, name: &str, default: i64) -> i64 {
        self.integers.get(name).copied().unwrap_or(default)
    }

    /// Returns the floating-point attribute of this name, or `default` without one.
    pub fn number(&self, name: &str, default: f32) -> f32 {
        self.numbers.get(name).copied().unwrap_or(default)
    }

    /// Returns the attribute of this name that is a list of integers; `None` without one.
    pub fn list(&self, name: &str) -> Option<&[i64]> {
        self.lists.get(name).map(Vec::as_slice)
    }
}

impl<'a> Input<'a> {
    fn read(bytes: &'a [u8]) -> Result<Self, Malformed> {
        let mut shape = None;
        // The shape is in the type of a tensor, which is in the type of the input.
        for kind in messages(bytes, 2)? {
            for tensor in messages(kind, 1)? {
                shape = messages(tensor, 2)?.pop().or(shape);
            }
        }
        let mut sizes = Vec::new();
        for axis in shape.map(|it| messages(it, 1)).transpose()?.unwrap_or_default() {
            let mut size = None;
            for field in Fields::of(axis) {
                if let (1, value) = field? {
                    size = usize::try_from(value.integer()?).ok().filter(|size| *size > 0);
                }
            }
            sizes.push(size);
        }
        Ok(Self { name: name_of(bytes)?, entries: entries_of(&sizes) })
    }
}

/// Returns the number of entries of one observation in a declared shape, whose first axis counts
/// observations unless it is the only one; `None` if the size of another axis is not declared.
fn entries_of(sizes: &[Option<usize>]) -> Option<usize> {
    let (last, others) = sizes.split_last()?;
    let between = others.get(1..).unwrap_or_default();
    between.iter().try_fold((*last)?, |entries, size| entries.checked_mul((*size)?))
}

/// Returns whether this is the domain of ONNX's own operators.
fn is_of_onnx(domain: &str) -> bool {
    matches!(domain, "" | "ai.onnx")
}

/// Returns the messages in the fields of this number.
fn messages(bytes: &[u8], number: u64) -> Result<Vec<&[u8]>, Malformed> {
    let mut found = Vec::new();
    for field in Fields::of(bytes) {
        let (field, value) = field?;
        if field == number {
            found.push(value.bytes()?);
        }
    }
    Ok(found)
}

/// Returns the text of field 1 of a message: in several of ONNX's messages, the name.
fn name_of(bytes: &[u8]) -> Result<&str, Malformed> {
    text_of(bytes, 1)
}

/// Returns the text of the field of this number, or an empty text without one.
fn text_of(bytes: &[u8], number: u64) -> Result<&str, Malformed> {
    let mut text = "";
    for field in Fields::of(bytes) {
        let (field, value) = field?;
        if field == number {
            text = value.text()?;
        }
    }
    Ok(text)
}

/// Reads a tensor and its name.
fn tensor(bytes: &[u8]) -> Result<(&str, Tensor), ImportError> {
    let (mut name, mut kind, mut is_outside) = ("", 0, false);
    let (mut shape, mut raw) = (Vec::new(), None);
    let (mut numbers, mut integers) = (Vec::new(), Vec::new());
    for field in Fields::of(bytes) {
        match field? {
            (1, value) => shape.extend(value.integers()?),
            (2, value) => kind = value.integer()?,
            (4, value) => numbers.extend(value.floats()?),
            (7, value) => integers.extend(value.integers()?),
            (8, value) => name = value.text()?,
            (9, value) => raw = Some(value.bytes()?),
            (10, value) => numbers.extend(doubles(value.bytes()?)?),
            (14, value) => is_outside = value.integer()? == 1,
            _ => {}
        }
    }
    if is_outside {
        return Err(ImportError::OtherFile { name: name.to_owned() });
    }
    let values = match (kind, raw) {
        (FLOAT, Some(raw)) => Values::Numbers(floats(raw)?),
        (DOUBLE, Some(raw)) => Values::Numbers(doubles(raw)?),
        (FLOAT | DOUBLE, None) => Values::Numbers(numbers),
        (INT64, Some(raw)) => Values::Integers(whole_numbers(raw)?),
        (INT64, None) => Values::Integers(integers),
        _ => Values::Unread,
    };
    let shape = shape.into_iter().map(|size| usize::try_from(size).map_err(|_| Malformed));
    let shape = shape.collect::<Result<Vec<_>, _>>()?;
    let count = shape.iter().try_fold(1_usize, |count, &size| count.checked_mul(size));
    let given = match &values {
        Values::Numbers(numbers) => Some(numbers.len()),
        Values::Integers(integers) => Some(integers.len()),
        Values::Unread => None,
    };
    if given.is_some() && count != given {
        return Err(ImportError::Values { name: name.to_owned() });
    }
    Ok((name, Tensor { shape, values }))
}

fn doubles(bytes: &[u8]) -> Result<Vec<f32>, Malformed> {
    let (numbers, []) = bytes.as_chunks() else { return Err(Malformed) };
    Ok(numbers.iter().map(|number| f64::from_le_bytes(*number) as f32).collect())
}

fn whole_numbers(bytes: &[u8]) -> Result<Vec<i64>, Malformed> {
    let (numbers, []) = bytes.as_chunks() else { return Err(Malformed) };
    Ok(numbers.iter().map(|number| i64::from_le_bytes(*number)).collect())
}
