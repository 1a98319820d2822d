//! Minimal XML writer for Mitsuba scenes: elements with attributes.

use std::fmt::{Display, Write as _};

/// XML element. Attributes and children keep their order.
pub(super) struct Element {
    tag: &'static str,
    attributes: Vec<(&'static str, String)>,
    children: Vec<Element>,
}

impl Element {
    pub(super) fn new(tag: &'static str) -> Self {
        Self { tag, attributes: vec![], children: vec![] }
    }

    /// Root element of a scene.
    pub(super) fn scene() -> Self {
        Self::new("scene").attribute("version", "3.0.0")
    }

    /// Element of a plug-in instance.
    pub(super) fn plugin(tag: &'static str, kind: &str) -> Self {
        Self::new(tag).attribute("type", kind)
    }

    pub(super) fn named(tag: &'static str, name: &str) -> Self {
        Self::new(tag).attribute("name", name)
    }

    /// Adds a parameter as a child element: `<tag name="…" value="…"/>`.
    pub(super) fn with(self, tag: &'static str, name: &str, value: impl Display) -> Self {
        self.child(Self::named(tag, name).attribute("value", value))
    }

    pub(super) fn attribute(mut self, name: &'static str, value: impl Display) -> Self {
        self.attributes.push((name, value.to_string()));
        self
    }

    pub(super) fn child(self, child: Self) -> Self {
        self.children([child])
    }

    pub(super) fn children(mut self, children: impl IntoIterator<Item = Self>) -> Self {
        self.children.extend(children);
        self
    }

    /// Text of a file with this root element.
    pub(super) fn document(&self) -> String {
        let mut text = concat!(
            "<?xml version=\"1.0\" encoding=\"utf-8\"?>\n",
            "<!-- Centaur ",
            env!("CARGO_PKG_VERSION"),
            " -->\n"
        )
        .to_owned();
        self.print(0, &mut text);
        text
    }

    fn print(&self, depth: usize, text: &mut String) {
        let indent = "  ".repeat(depth);
        let attributes = self.attributes.iter().map(|(name, value)| format!(" {name}=\"{}\"", escaped(value)));
        let attributes: String = attributes.collect();
        if self.children.is_empty() {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "{indent}<{}{attributes}/>", self.tag);
            return;
        }
        let _ = writeln!(text, "{indent}<{}{attributes}>", self.tag);
        self.children.iter().for_each(|child| child.print(depth + 1, text));
        let _ = writeln!(text, "{indent}</{}>", self.tag);
    }
}

/// List of numbers, each written so that it is read back exactly.
pub(super) fn numbers<T: Display>(values: &[T]) -> String {
    values.iter().map(T::to_string).collect::<Vec<_>>().join(" ")
}

/// Escapes text for an attribute. Characters that XML forbids (control characters) become `_`; so does `$`, which
/// begins a parameter in Mitsuba.
fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            '$' | '\u{fffe}' | '\u{ffff}' => escaped.push('_'),
            c if c.is_control() => escaped.push('_'),
            c => escaped.push(c),
        }
    }
    escaped
}
