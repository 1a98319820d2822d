//! USD layer as plain data: the syntactic content of a `.usda`, not yet interpreted.

use std::borrow::Cow;
use std::collections::HashSet;

use glam::{DMat4, DQuat};

use crate::format::placed::similarity;

/// Layer: the content of one file.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Layer {
    pub(super) metadata: Vec<Field>,
    pub(super) prims: Vec<Prim>,
}

/// Metadata entry: `upAxis = "Y"`, `prepend apiSchemas = ["MaterialBindingAPI"]`.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Field {
    pub(super) edit: Option<ListEdit>,
    pub(super) name: String,
    pub(super) value: Value,
}

/// Edit that a list applies to that of weaker layers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ListEdit {
    Prepend,
    Append,
    Add,
    Delete,
    Reorder,
}

impl ListEdit {
    pub(super) const ALL: [Self; 5] = [Self::Prepend, Self::Append, Self::Add, Self::Delete, Self::Reorder];

    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Prepend => "prepend",
            Self::Append => "append",
            Self::Add => "add",
            Self::Delete => "delete",
            Self::Reorder => "reorder",
        }
    }

    /// Whether it adds items. Others change items of weaker layers only.
    pub(super) fn adds(self) -> bool {
        !matches!(self, Self::Delete | Self::Reorder)
    }

    /// Place of an edit's items in the list to which all edits of a layer lead, from the front; `None`: no edit.
    pub(super) fn place(edit: Option<Self>) -> u8 {
        match edit {
            None | Some(Self::Prepend) => 0,
            Some(Self::Add) => 1,
            Some(Self::Append) => 2,
            Some(Self::Delete | Self::Reorder) => 3,
        }
    }
}

/// Specifier of a prim.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Specifier {
    #[default]
    Def,
    Over,
    Class,
}

impl Specifier {
    pub(super) const ALL: [Self; 3] = [Self::Def, Self::Over, Self::Class];

    pub(super) fn word(self) -> &'static str {
        match self {
            Self::Def => "def",
            Self::Over => "over",
            Self::Class => "class",
        }
    }
}

/// Prim with its properties and children.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Prim {
    pub(super) specifier: Specifier,
    /// Type name, such as `Mesh`; empty if none is stated.
    pub(super) type_name: String,
    pub(super) name: String,
    pub(super) metadata: Vec<Field>,
    pub(super) properties: Vec<Property>,
    pub(super) children: Vec<Prim>,
    pub(super) variants: Vec<Variant>,
}

/// Additional content of a prim while the variant set `set` has the selection `name`. Has no specifier, type or name of
/// its own.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Variant {
    pub(super) set: String,
    pub(super) name: String,
    pub(super) content: Prim,
}

/// Attribute or relationship.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Property {
    pub(super) name: String,
    pub(super) custom: bool,
    pub(super) uniform: bool,
    pub(super) kind: PropertyKind,
    pub(super) metadata: Vec<Field>,
}

#[derive(Clone, Debug, PartialEq)]
pub(super) enum PropertyKind {
    Attribute {
        /// Type name, with `[]` for arrays: `point3f[]`.
        type_name: String,
        value: Option<Value>,
        /// Values by time code, in the file's order.
        samples: Vec<(f64, Value)>,
        connections: Option<Targets>,
    },
    Relationship {
        targets: Option<Targets>,
    },
}

/// Paths to which a relationship or a connection leads, and the list edit by which they are stated.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Targets {
    pub(super) edit: Option<ListEdit>,
    pub(super) paths: Vec<String>,
}

impl Targets {
    /// Paths stated without a list edit.
    pub(super) fn explicit(paths: Vec<String>) -> Self {
        Self { edit: None, paths }
    }

    /// First path to which they lead.
    fn first(&self) -> Option<&str> {
        self.paths.first().filter(|_| self.edit.is_none_or(ListEdit::adds)).map(String::as_str)
    }

    /// Merges a later statement about the same property: the one in front is kept, as only the first path is read.
    pub(super) fn merge(&mut self, later: Self) {
        if ListEdit::place(later.edit) <= ListEdit::place(self.edit) {
            *self = later;
        }
    }

    /// List to which the paths lead if a weaker layer or arc states `weaker`.
    pub(super) fn over(self, weaker: Self) -> Self {
        let own: HashSet<&str> = self.paths.iter().map(String::as_str).collect();
        let is_below = |path: &&String| weaker.edit.is_none_or(ListEdit::adds) && !own.contains(path.as_str());
        let below: Vec<String> = weaker.paths.iter().filter(is_below).cloned().collect();
        match self.edit {
            None => self,
            Some(ListEdit::Prepend) => Self::explicit([self.paths, below].concat()),
            Some(ListEdit::Add | ListEdit::Append) => Self::explicit([below, self.paths].concat()),
            Some(ListEdit::Delete) => Self::explicit(below),
            Some(ListEdit::Reorder) => weaker,
        }
    }
}

/// Parts of a path: the prim's path, and the property's name, which is empty if the path is that of a prim.
pub(super) fn split_property(path: &str) -> (&str, &str) {
    let last = path.rfind('/').map_or(0, |i| i + 1);
    match path[last..].find('.').filter(|_| &path[last..] != "..") {
        Some(dot) => (&path[..last + dot], &path[last + dot + 1..]),
        None => (path, ""),
    }
}

/// Value. Those of attributes with a numeric type are flat: `[(1, 2, 3)]` of `point3f[]` is `Floats([1, 2, 3])`.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Value {
    /// `None`: blocks the value of weaker layers.
    Blocked,
    /// Numbers of half or single precision.
    Floats(Vec<f32>),
    /// Numbers of double precision.
    Doubles(Vec<f64>),
    /// Booleans, and integers of any size.
    Integers(Vec<i64>),
    /// Number without a stated type, in metadata.
    Number(f64),
    /// String or token.
    Text(String),
    /// Asset path, `@path@`.
    Asset(String),
    /// Reference or payload, `@path@</prim>`.
    Reference(String, String),
    /// Path of a prim or property, `</prim.property>`.
    Path(String),
    List(Vec<Value>),
    Tuple(Vec<Value>),
    Dictionary(Vec<Entry>),
}

/// Entry of a dictionary, `double3 key = (1, 2, 3)`. The type is empty where the dictionary is a map of paths.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Entry {
    pub(super) type_name: String,
    pub(super) key: String,
    pub(super) value: Value,
}

/// Number type of a numeric type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    Float,
    Double,
    Integer,
}

/// Shape of one element of a numeric type: `point3f` is 1×3, `matrix4d` 4×4.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Numeric {
    pub(super) scalar: Scalar,
    pub(super) rows: usize,
    pub(super) columns: usize,
}

impl Numeric {
    /// Parses a type name, with or without `[]`; `None` for strings, assets, dictionaries and unknown types.
    pub(super) fn of(type_name: &str) -> Option<Self> {
        let name = type_name.strip_suffix("[]").unwrap_or(type_name);
        let vector = |scalar, columns| Some(Self { scalar, rows: 1, columns });
        match name {
            "bool" | "uchar" | "int" | "uint" | "int64" | "uint64" => return vector(Scalar::Integer, 1),
            "half" | "float" => return vector(Scalar::Float, 1),
            "double" | "timecode" => return vector(Scalar::Double, 1),
            "int2" => return vector(Scalar::Integer, 2),
            "int3" => return vector(Scalar::Integer, 3),
            "int4" => return vector(Scalar::Integer, 4),
            _ => {}
        }
        // Names such as `half3` and `float3` end in their size, `point3f` in size and precision.
        for (prefix, scalar) in [("half", Scalar::Float), ("float", Scalar::Float), ("double", Scalar::Double)] {
            if let Some(size) = name.strip_prefix(prefix) {
                return vector(scalar, size_of(size).filter(|n| (2..=4).contains(n))?);
            }
        }
        let (role, precision) = name.split_at_checked(name.len().checked_sub(1)?)?;
        let scalar = match precision {
            "h" | "f" => Scalar::Float,
            "d" => Scalar::Double,
            _ => return None,
        };
        match role {
            "quat" => vector(scalar, 4),
            "point3" | "normal3" | "vector3" | "color3" | "texCoord3" => vector(scalar, 3),
            "color4" => vector(scalar, 4),
            "texCoord2" => vector(scalar, 2),
            "frame4" if scalar == Scalar::Double => Some(Self { scalar, rows: 4, columns: 4 }),
            _ if scalar == Scalar::Double => {
                let size = size_of(role.strip_prefix("matrix")?).filter(|n| (2..=4).contains(n))?;
                Some(Self { scalar, rows: size, columns: size })
            }
            _ => None,
        }
    }

    /// Number of numbers per element.
    pub(super) fn width(self) -> usize {
        self.rows * self.columns
    }
}

fn size_of(digit: &str) -> Option<usize> {
    let &[digit] = digit.as_bytes() else { return None };
    digit.is_ascii_digit().then(|| usize::from(digit - b'0'))
}

impl Layer {
    /// Sorts time samples by time, as [`Prim::value_at`] requires.
    pub(super) fn sort_samples(&mut self) {
        let mut prims: Vec<&mut Prim> = self.prims.iter_mut().collect();
        while let Some(prim) = prims.pop() {
            for property in &mut prim.properties {
                if let PropertyKind::Attribute { samples, .. } = &mut property.kind {
                    samples.sort_by(|a, b| a.0.total_cmp(&b.0));
                }
            }
            prims.extend(&mut prim.children);
        }
    }

    pub(super) fn field(&self, name: &str) -> Option<&Value> {
        field(&self.metadata, name)
    }
}

pub(super) fn field<'a>(metadata: &'a [Field], name: &str) -> Option<&'a Value> {
    metadata.iter().find(|f| f.name == name).map(|f| &f.value)
}

impl Prim {
    pub(super) fn new(type_name: &str, name: &str) -> Self {
        Self { type_name: type_name.to_owned(), name: name.to_owned(), ..Self::default() }
    }

    /// Adds an attribute defined by the prim's schema.
    pub(super) fn set(&mut self, type_name: &str, name: &str, value: Value) -> &mut Property {
        self.add(type_name, name, Some(value), None)
    }

    /// Same as [`Self::set`], for an attribute that does not vary over time.
    pub(super) fn set_uniform(&mut self, type_name: &str, name: &str, value: Value) {
        self.set(type_name, name, value).uniform = true;
    }

    /// Adds an attribute that no schema defines.
    pub(super) fn set_custom(&mut self, type_name: &str, name: &str, value: Value) {
        self.set(type_name, name, value).custom = true;
    }

    /// Adds an attribute without a value: an output of a shader.
    pub(super) fn declare(&mut self, type_name: &str, name: &str) {
        self.add(type_name, name, None, None);
    }

    /// Adds an attribute connected to another one as its source.
    pub(super) fn connect(&mut self, type_name: &str, name: &str, source: String) {
        self.add(type_name, name, None, Some(Targets::explicit(vec![source])));
    }

    fn add(
        &mut self,
        type_name: &str,
        name: &str,
        value: Option<Value>,
        connections: Option<Targets>,
    ) -> &mut Property {
        let kind = PropertyKind::Attribute { type_name: type_name.to_owned(), value, samples: vec![], connections };
        self.properties.push(Property { name: name.to_owned(), custom: false, uniform: false, kind, metadata: vec![] });
        self.properties.last_mut().expect("one was pushed")
    }

    /// Adds a relationship to one target.
    pub(super) fn relate(&mut self, name: &str, target: String) {
        let kind = PropertyKind::Relationship { targets: Some(Targets::explicit(vec![target])) };
        self.properties.push(Property { name: name.to_owned(), custom: false, uniform: false, kind, metadata: vec![] });
    }

    /// Applies an API schema in addition to the type's schema.
    pub(super) fn apply(&mut self, schema: &str) {
        let value = Value::List(vec![Value::Text(schema.to_owned())]);
        self.metadata.push(Field { edit: Some(ListEdit::Prepend), name: "apiSchemas".to_owned(), value });
    }

    pub(super) fn property(&self, name: &str) -> Option<&Property> {
        self.properties.iter().find(|p| p.name == name)
    }

    /// Text in the metadata `name` of a property.
    pub(super) fn stated(&self, property: &str, name: &str) -> Option<&str> {
        field(&self.property(property)?.metadata, name)?.as_text()
    }

    /// Value of an attribute at the earliest time: its first sample, or else its default, which samples hide at all
    /// times. `None` if there is no value, or it is blocked.
    pub(super) fn value(&self, name: &str) -> Option<&Value> {
        let PropertyKind::Attribute { value, samples, .. } = &self.property(name)?.kind else { return None };
        let first = samples.iter().min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, value)| value);
        first.or(value.as_ref()).filter(|v| **v != Value::Blocked)
    }

    /// Time samples of an attribute.
    pub(super) fn samples(&self, name: &str) -> &[(f64, Value)] {
        match self.property(name).map(|p| &p.kind) {
            Some(PropertyKind::Attribute { samples, .. }) => samples,
            _ => &[],
        }
    }

    /// Value of an attribute at a time code, given sorted samples: held before the first and after the last; between
    /// two samples, interpolated linearly if numeric, along the shorter arc for rotations.
    pub(super) fn value_at(&self, name: &str, time: f64) -> Option<Cow<'_, Value>> {
        let PropertyKind::Attribute { type_name, samples, .. } = &self.property(name)?.kind else { return None };
        let after = samples.partition_point(|(at, _)| *at <= time);
        let found = match (after.checked_sub(1).map(|i| &samples[i]), samples.get(after)) {
            (None, None) => return self.value(name).map(Cow::Borrowed),
            (None, Some((_, only))) | (Some((_, only)), None) => Cow::Borrowed(only),
            (Some((start, first)), Some((end, second))) => {
                between(type_name, first, second, (time - start) / (end - start))
            }
        };
        Some(found).filter(|v| **v != Value::Blocked)
    }

    /// Source to which an attribute is connected.
    pub(super) fn connection(&self, name: &str) -> Option<&str> {
        let PropertyKind::Attribute { connections, .. } = &self.property(name)?.kind else { return None };
        connections.as_ref()?.first()
    }

    /// First target of a relationship.
    pub(super) fn target(&self, name: &str) -> Option<&str> {
        let PropertyKind::Relationship { targets } = &self.property(name)?.kind else { return None };
        targets.as_ref()?.first()
    }
}

/// Interpolates from `first`, at u = 0, to `second`, at u = 1; returns `first` where values cannot be interpolated.
fn between<'a>(type_name: &str, first: &'a Value, second: &Value, u: f64) -> Cow<'a, Value> {
    let (Some(a), Some(b)) = (first.as_numbers(), second.as_numbers()) else { return Cow::Borrowed(first) };
    if u == 0.0 || a.len() != b.len() || matches!(first, Value::Integers(_)) {
        return Cow::Borrowed(first);
    }
    let linear = || a.iter().zip(&b).map(|(a, b)| a + (b - a) * u).collect();
    let matrix = |values: &[f64]| <[f64; 16]>::try_from(values).ok().map(|all| DMat4::from_cols_array(&all));
    let numbers = match (type_name, &a[..], &b[..]) {
        ("quath" | "quatf" | "quatd", &[w, x, y, z], &[w1, x1, y1, z1]) => {
            let q = DQuat::from_xyzw(x, y, z, w).slerp(DQuat::from_xyzw(x1, y1, z1, w1), u);
            vec![q.w, q.x, q.y, q.z]
        }
        // USD interpolates matrix entries, which would shrink rotating objects; interpolating the similarity keeps a
        // camera valid.
        ("matrix4d", a, b) => match (matrix(a).and_then(similarity), matrix(b).and_then(similarity)) {
            (Some(a), Some(b)) => {
                let scale = glam::DVec3::splat(a.scale + (b.scale - a.scale) * u);
                let rotation = a.rotation.slerp(b.rotation, u);
                let between = a.translation.lerp(b.translation, u);
                DMat4::from_scale_rotation_translation(scale, rotation, between).to_cols_array().to_vec()
            }
            _ => linear(),
        },
        _ => linear(),
    };
    Cow::Owned(Value::Doubles(numbers))
}

impl Property {
    /// Name of the metadata with which a binary layer stores a spline. Splines are not read.
    pub(super) const SPLINE: &str = "spline";

    /// Whether a spline animates the attribute.
    pub(super) fn has_spline(&self) -> bool {
        field(&self.metadata, Self::SPLINE).is_some()
    }

    pub(super) fn with(&mut self, name: &str, value: Value) -> &mut Self {
        self.metadata.push(Field { edit: None, name: name.to_owned(), value });
        self
    }
}

impl Value {
    pub(super) fn text(text: &str) -> Self {
        Self::Text(text.to_owned())
    }

    /// String, token, asset or path of the value.
    pub(super) fn as_text(&self) -> Option<&str> {
        match self {
            Self::Text(text) | Self::Asset(text) | Self::Path(text) => Some(text),
            _ => None,
        }
    }

    /// First number of the value.
    pub(super) fn as_number(&self) -> Option<f64> {
        match self {
            Self::Number(n) => Some(*n),
            Self::Floats(all) => all.first().map(|&v| f64::from(v)),
            Self::Doubles(all) => all.first().copied(),
            Self::Integers(all) => all.first().map(|&v| v as f64),
            _ => None,
        }
    }

    /// All numbers of the value.
    pub(super) fn as_numbers(&self) -> Option<Vec<f64>> {
        match self {
            Self::Number(n) => Some(vec![*n]),
            Self::Floats(all) => Some(all.iter().map(|&v| f64::from(v)).collect()),
            Self::Doubles(all) => Some(all.clone()),
            Self::Integers(all) => Some(all.iter().map(|&v| v as f64).collect()),
            _ => None,
        }
    }
}
