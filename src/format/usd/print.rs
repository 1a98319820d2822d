//! Writer of a layer as text, in the layout of USD's own writer. Floats have enough digits to be read back bit for bit.

use std::fmt::{Display, LowerExp, Write as _};
use std::io::{self, Write};

use rayon::prelude::*;

use super::document::{Entry, Field, Layer, ListEdit, Numeric, Prim, Property, PropertyKind, Scalar, Targets, Value};

/// Number of elements that one task formats, and of tasks whose text is held in memory at a time: about 50 MB.
const ELEMENTS: usize = 1 << 14;
const TASKS: usize = 64;

pub(super) fn print(layer: &Layer, out: &mut impl Write) -> io::Result<()> {
    let mut printer = Printer { out, indent: 0 };
    write!(printer.out, "#usda 1.0")?;
    if !layer.metadata.is_empty() {
        writeln!(printer.out)?;
    }
    printer.metadata(&layer.metadata, "")?;
    writeln!(printer.out)?;
    for prim in &layer.prims {
        writeln!(printer.out)?;
        printer.prim(prim)?;
    }
    Ok(())
}

struct Printer<'a, W> {
    out: &'a mut W,
    indent: usize,
}

impl<W: Write> Printer<'_, W> {
    fn line_start(&mut self) -> io::Result<()> {
        write!(self.out, "{:1$}", "", 4 * self.indent)
    }

    /// Writes metadata in parentheses after `space`; nothing if there is none. Leaves the line open.
    fn metadata(&mut self, fields: &[Field], space: &str) -> io::Result<()> {
        if fields.is_empty() {
            return Ok(());
        }
        writeln!(self.out, "{space}(")?;
        self.indent += 1;
        for field in fields {
            self.line_start()?;
            if field.name == "comment" {
                self.value("", &field.value)?;
            } else {
                write!(self.out, "{}{} = ", edit(field.edit), field.name)?;
                self.value("", &field.value)?;
            }
            writeln!(self.out)?;
        }
        self.indent -= 1;
        self.line_start()?;
        write!(self.out, ")")
    }

    fn prim(&mut self, prim: &Prim) -> io::Result<()> {
        self.line_start()?;
        let type_name = if prim.type_name.is_empty() { String::new() } else { format!("{} ", prim.type_name) };
        write!(self.out, "{} {type_name}{}", prim.specifier.word(), quoted(&prim.name))?;
        self.metadata(&prim.metadata, " ")?;
        writeln!(self.out)?;
        self.line_start()?;
        self.body(prim)?;
        writeln!(self.out)
    }

    fn body(&mut self, prim: &Prim) -> io::Result<()> {
        writeln!(self.out, "{{")?;
        self.indent += 1;
        for property in &prim.properties {
            self.property(property)?;
        }
        for (i, child) in prim.children.iter().enumerate() {
            if i > 0 || !prim.properties.is_empty() {
                writeln!(self.out)?;
            }
            self.prim(child)?;
        }
        let mut rest = &prim.variants[..];
        while let Some(first) = rest.first() {
            let count = rest.iter().take_while(|v| v.set == first.set).count();
            self.line_start()?;
            writeln!(self.out, "variantSet {} = {{", quoted(&first.set))?;
            self.indent += 1;
            for variant in &rest[..count] {
                self.line_start()?;
                write!(self.out, "{} ", quoted(&variant.name))?;
                self.metadata(&variant.content.metadata, "")?;
                self.body(&variant.content)?;
                writeln!(self.out)?;
            }
            self.indent -= 1;
            self.line_start()?;
            writeln!(self.out, "}}")?;
            rest = &rest[count..];
        }
        self.indent -= 1;
        self.line_start()?;
        write!(self.out, "}}")
    }

    fn property(&mut self, property: &Property) -> io::Result<()> {
        let custom = if property.custom { "custom " } else { "" };
        let uniform = if property.uniform { "uniform " } else { "" };
        let name = &property.name;
        match &property.kind {
            PropertyKind::Relationship { targets } => {
                self.line_start()?;
                write!(self.out, "{custom}{}rel {name}", edit(targets.as_ref().and_then(|t| t.edit)))?;
                if let Some(targets) = targets {
                    write!(self.out, " = {}", paths(&targets.paths))?;
                }
                self.metadata(&property.metadata, " ")?;
                writeln!(self.out)
            }
            PropertyKind::Attribute { type_name, value, samples, connections } => {
                // The declaration carries the metadata; it is omitted if samples or connections say everything.
                let declares = value.is_some() || !property.metadata.is_empty();
                if declares || (samples.is_empty() && connections.is_none()) {
                    self.line_start()?;
                    write!(self.out, "{custom}{uniform}{type_name} {name}")?;
                    if let Some(value) = value {
                        write!(self.out, " = ")?;
                        self.value(type_name, value)?;
                    }
                    self.metadata(&property.metadata, " ")?;
                    writeln!(self.out)?;
                }
                if !samples.is_empty() {
                    self.line_start()?;
                    writeln!(self.out, "{custom}{uniform}{type_name} {name}.timeSamples = {{")?;
                    self.indent += 1;
                    for (time, value) in samples {
                        self.line_start()?;
                        write!(self.out, "{}: ", Shortest(*time))?;
                        self.value(type_name, value)?;
                        writeln!(self.out, ",")?;
                    }
                    self.indent -= 1;
                    self.line_start()?;
                    writeln!(self.out, "}}")?;
                }
                if let Some(Targets { edit: list_edit, paths: sources }) = connections {
                    self.line_start()?;
                    let edit = edit(*list_edit);
                    writeln!(self.out, "{edit}{custom}{uniform}{type_name} {name}.connect = {}", paths(sources))?;
                }
                Ok(())
            }
        }
    }

    /// Writes a value of a type; the type is empty if none is stated.
    fn value(&mut self, type_name: &str, value: &Value) -> io::Result<()> {
        let numeric = Numeric::of(type_name).unwrap_or(Numeric { scalar: Scalar::Double, rows: 1, columns: 1 });
        let is_array = type_name.ends_with("[]");
        match value {
            Value::Blocked => write!(self.out, "None"),
            Value::Floats(all) => self.numbers(all, numeric, is_array, |v, text| push(text, &Shortest(*v))),
            Value::Doubles(all) => self.numbers(all, numeric, is_array, |v, text| push(text, &Shortest(*v))),
            Value::Integers(all) => self.numbers(all, numeric, is_array, |v, text| push(text, v)),
            Value::Number(n) => write!(self.out, "{}", Shortest(*n)),
            Value::Text(text) => write!(self.out, "{}", quoted(text)),
            Value::Asset(path) => write!(self.out, "{}", asset(path)),
            Value::Reference(path, prim) => write!(self.out, "{}<{prim}>", asset(path)),
            Value::Path(path) => write!(self.out, "<{path}>"),
            Value::List(values) => self.list('[', values, ']'),
            Value::Tuple(values) => self.list('(', values, ')'),
            Value::Dictionary(entries) => self.dictionary(entries),
        }
    }

    fn list(&mut self, open: char, values: &[Value], close: char) -> io::Result<()> {
        write!(self.out, "{open}")?;
        for (i, value) in values.iter().enumerate() {
            if i > 0 {
                write!(self.out, ", ")?;
            }
            self.value("", value)?;
        }
        write!(self.out, "{close}")
    }

    fn dictionary(&mut self, entries: &[Entry]) -> io::Result<()> {
        writeln!(self.out, "{{")?;
        self.indent += 1;
        for Entry { type_name, key, value } in entries {
            self.line_start()?;
            if type_name.is_empty() {
                write!(self.out, "<{key}>: ")?;
                self.value("", value)?;
                writeln!(self.out, ",")?;
                continue;
            }
            let is_word = key.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'_')
                && key.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_');
            let key = if is_word { key.clone() } else { quoted(key) };
            write!(self.out, "{type_name} {key} = ")?;
            self.value(type_name, value)?;
            writeln!(self.out)?;
        }
        self.indent -= 1;
        self.line_start()?;
        write!(self.out, "}}")
    }

    /// Writes elements of an array, many in parallel.
    fn numbers<T: Sync>(
        &mut self,
        all: &[T],
        numeric: Numeric,
        is_array: bool,
        one: impl Fn(&T, &mut String) + Sync,
    ) -> io::Result<()> {
        let text_of = |elements: &[T]| {
            let mut text = String::with_capacity(elements.len() * 12);
            for (i, element) in elements.chunks(numeric.width()).enumerate() {
                text.push_str(if i > 0 { ", " } else { "" });
                text.push_str(if numeric.rows > 1 { "(" } else { "" });
                for (i, row) in element.chunks(numeric.columns).enumerate() {
                    text.push_str(if i > 0 { ", " } else { "" });
                    text.push_str(if numeric.columns > 1 { "(" } else { "" });
                    for (i, number) in row.iter().enumerate() {
                        text.push_str(if i > 0 { ", " } else { "" });
                        one(number, &mut text);
                    }
                    text.push_str(if numeric.columns > 1 { ")" } else { "" });
                }
                text.push_str(if numeric.rows > 1 { ")" } else { "" });
            }
            text
        };
        if !is_array {
            return write!(self.out, "{}", text_of(all));
        }
        write!(self.out, "[")?;
        for (i, part) in all.chunks(ELEMENTS * TASKS * numeric.width()).enumerate() {
            let texts: Vec<String> = part.par_chunks(ELEMENTS * numeric.width()).map(text_of).collect();
            for (j, text) in texts.iter().enumerate() {
                write!(self.out, "{}{text}", if i + j > 0 { ", " } else { "" })?;
            }
        }
        write!(self.out, "]")
    }
}

fn push(text: &mut String, value: &impl Display) {
    write!(text, "{value}").expect("writing to a string cannot fail");
}

fn edit(edit: Option<ListEdit>) -> String {
    edit.map_or_else(String::new, |edit| format!("{} ", edit.word()))
}

fn paths(paths: &[String]) -> String {
    match paths {
        [one] => format!("<{one}>"),
        [] => "None".to_owned(),
        many => {
            let many: Vec<String> = many.iter().map(|path| format!("<{path}>")).collect();
            format!("[{}]", many.join(", "))
        }
    }
}

fn asset(path: &str) -> String {
    if path.contains('@') { format!("@@@{}@@@", path.replace("@@@", "\\@@@")) } else { format!("@{path}@") }
}

fn quoted(text: &str) -> String {
    let mut quoted = String::with_capacity(text.len() + 2);
    quoted.push('"');
    for c in text.chars() {
        match c {
            '"' => quoted.push_str("\\\""),
            '\\' => quoted.push_str("\\\\"),
            '\n' => quoted.push_str("\\n"),
            '\r' => quoted.push_str("\\r"),
            '\t' => quoted.push_str("\\t"),
            c if c.is_ascii_control() => push(&mut quoted, &format_args!("\\x{:02x}", u32::from(c))),
            c => quoted.push(c),
        }
    }
    quoted.push('"');
    quoted
}

/// Float in the fewest digits that are read back as the same float.
struct Shortest<T>(T);

impl<T: Copy + Into<f64> + Display + LowerExp> Display for Shortest<T> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let value: f64 = self.0.into();
        let size = value.abs();
        if value.is_nan() {
            write!(f, "nan")
        } else if value == 0.0 && value.is_sign_negative() {
            // `-0` would be an integer, which has no sign.
            write!(f, "-0.0")
        } else if size == 0.0 || (1e-4..1e9).contains(&size) || size.is_infinite() {
            write!(f, "{}", self.0)
        } else {
            write!(f, "{:e}", self.0)
        }
    }
}
