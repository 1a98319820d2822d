//! Further per-splat attributes, and the types of their values.

/// Per-splat property other than the parameters of the INRIA layout, with the name and type of the file: a label, a
/// confidence, a time. Only PLY can store it.
#[derive(Clone, Debug, PartialEq)]
pub struct Attribute {
    pub(super) name: String,
    pub(super) kind: Scalar,
    pub(super) values: Vec<f64>,
}

impl Attribute {
    /// Name of the property in the file.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Values, one per splat. Every PLY type fits into f64.
    #[must_use]
    pub fn values(&self) -> &[f64] {
        &self.values
    }

    /// Selects the values of the splats `indices`, in that order.
    ///
    /// # Panics
    /// If an index is out of range.
    #[must_use]
    pub fn gather(&self, indices: &[usize]) -> Self {
        Self { values: indices.iter().map(|&i| self.values[i]).collect(), ..self.same_kind() }
    }

    /// Concatenates the values of several scenes; `None` if names or types differ.
    #[must_use]
    pub fn join(parts: &[&Self]) -> Option<Self> {
        let first = parts.first()?;
        let same = parts.iter().all(|p| (&p.name, p.kind) == (&first.name, first.kind));
        let values = || parts.iter().flat_map(|p| p.values.iter().copied()).collect();
        same.then(|| Self { values: values(), ..first.same_kind() })
    }

    fn same_kind(&self) -> Self {
        Self { name: self.name.clone(), kind: self.kind, values: vec![] }
    }
}

/// Type of a scalar property of a PLY.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    pub(super) fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Name of the type in headers of PLY 1.0.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::I8 => "char",
            Self::U8 => "uchar",
            Self::I16 => "short",
            Self::U16 => "ushort",
            Self::I32 => "int",
            Self::U32 => "uint",
            Self::F32 => "float",
            Self::F64 => "double",
        }
    }

    /// Appends a value of this type, little endian.
    pub(super) fn encode(self, value: f64, out: &mut Vec<u8>) {
        match self {
            Self::I8 => out.extend((value as i8).to_le_bytes()),
            Self::U8 => out.extend((value as u8).to_le_bytes()),
            Self::I16 => out.extend((value as i16).to_le_bytes()),
            Self::U16 => out.extend((value as u16).to_le_bytes()),
            Self::I32 => out.extend((value as i32).to_le_bytes()),
            Self::U32 => out.extend((value as u32).to_le_bytes()),
            Self::F32 => out.extend((value as f32).to_le_bytes()),
            Self::F64 => out.extend(value.to_le_bytes()),
        }
    }

    pub(super) fn bytes(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}
