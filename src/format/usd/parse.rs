//! Parser of `.usda`.

use std::collections::HashMap;

use super::document::{
    Entry, Field, Layer, ListEdit, Numeric, Prim, Property, PropertyKind, Scalar, Specifier, Targets, Value, Variant,
};
use super::lex::Cursor;
use crate::format::error::Fault;

/// Greatest nesting depth of prims, lists and dictionaries: far above real files, far below what a thread's stack can
/// hold.
const MAX_DEPTH: usize = 200;

/// What a statement about an attribute may assign, for messages.
const ASSIGNED: &str = "a value, .connect, .timeSamples or .spline";

/// Parses the text of a layer, in time and memory proportional to its length.
pub(super) fn parse(bytes: &[u8]) -> Result<Layer, Fault> {
    let text = std::str::from_utf8(bytes)
        .map_err(|e| Fault::byte(e.valid_up_to(), "UTF-8", format!("byte {:#04x}", bytes[e.valid_up_to()])))?;
    let mut cursor = Cursor::new(text);
    if !text.starts_with("#usda 1.") {
        return Err(cursor.fault("`#usda 1.0`"));
    }
    // To the cursor, the first line is a comment.
    let metadata = cursor.metadata(0)?;
    let mut prims = vec![];
    loop {
        cursor.skip_separators()?;
        match cursor.peek_word()? {
            Some("reorder") => cursor.reorder(0)?,
            Some(_) => prims.push(cursor.prim(0)?),
            None if cursor.peek()?.is_none() => return Ok(Layer { metadata, prims }),
            None => return Err(cursor.fault("def, over or class")),
        }
    }
}

impl Cursor<'_> {
    fn deeper(&self, depth: usize) -> Result<usize, Fault> {
        if depth < MAX_DEPTH {
            Ok(depth + 1)
        } else {
            Err(self.fault(format!("at most {MAX_DEPTH} levels of nesting")))
        }
    }

    /// Skips `reorder nameChildren = ["b", "a"]`, which does not affect content.
    fn reorder(&mut self, depth: usize) -> Result<(), Fault> {
        self.word("reorder")?;
        if self.word("what to reorder")? == "rel" {
            self.word("the name of a relationship")?;
        }
        self.expect(b'=')?;
        self.value(depth).map(drop)
    }

    /// Metadata in parentheses after a layer's first line, a prim's name or an attribute's value.
    fn metadata(&mut self, depth: usize) -> Result<Vec<Field>, Fault> {
        let mut fields = vec![];
        if !self.eat(b'(')? {
            return Ok(fields);
        }
        loop {
            self.skip_separators()?;
            if self.eat(b')')? {
                return Ok(fields);
            }
            if self.at_string()? {
                let value = Value::Text(self.string()?);
                fields.push(Field { edit: None, name: "comment".to_owned(), value });
                continue;
            }
            let edit = self.list_edit()?;
            let name = self.word("a name of metadata or `)`")?.to_owned();
            self.expect(b'=')?;
            let value = self.arc(depth)?;
            fields.push(Field { edit, name, value });
        }
    }

    /// Keyword of a list edit, if one follows that is not itself a name.
    fn list_edit(&mut self) -> Result<Option<ListEdit>, Fault> {
        let word = self.peek_word()?;
        let edit = ListEdit::ALL.into_iter().find(|edit| Some(edit.word()) == word);
        if edit.is_some() {
            self.word("a word")?;
        }
        Ok(edit)
    }

    fn prim(&mut self, depth: usize) -> Result<Prim, Fault> {
        let word = self.peek_word()?;
        let specifier = Specifier::ALL.into_iter().find(|s| Some(s.word()) == word);
        let specifier = specifier.ok_or_else(|| self.fault("def, over or class"))?;
        self.word("a word")?;
        let type_name = if self.at_string()? { "" } else { self.word("a type or a name in quotes")? }.to_owned();
        let name = self.string()?;
        if name.is_empty() || name.contains('/') {
            return Err(self.fault_at(self.offset(), "a name of a prim", format!("`{name}`")));
        }
        let metadata = self.metadata(depth)?;
        let mut prim = Prim { specifier, type_name, name, metadata, ..Prim::default() };
        self.body(&mut prim, depth)?;
        Ok(prim)
    }

    /// Body in braces: properties, prims and variants.
    fn body(&mut self, prim: &mut Prim, depth: usize) -> Result<(), Fault> {
        let depth = self.deeper(depth)?;
        self.expect(b'{')?;
        let mut known = HashMap::new();
        loop {
            self.skip_separators()?;
            if self.eat(b'}')? {
                return Ok(());
            }
            match self.peek_word()? {
                Some("def" | "over" | "class") => prim.children.push(self.prim(depth)?),
                Some("variantSet") => self.variant_set(prim, depth)?,
                Some("reorder") => self.reorder(depth)?,
                Some(_) => self.property(&mut prim.properties, &mut known, depth)?,
                None => return Err(self.fault("a property, a prim or `}`")),
            }
        }
    }

    fn variant_set(&mut self, prim: &mut Prim, depth: usize) -> Result<(), Fault> {
        let depth = self.deeper(depth)?;
        self.word("variantSet")?;
        let set = self.string()?;
        self.expect(b'=')?;
        self.expect(b'{')?;
        loop {
            self.skip_separators()?;
            if self.eat(b'}')? {
                return Ok(());
            }
            let name = self.string()?;
            let mut content = Prim { metadata: self.metadata(depth)?, ..Prim::default() };
            self.body(&mut content, depth)?;
            prim.variants.push(Variant { set: set.clone(), name, content });
        }
    }

    /// Parses one statement about an attribute or a relationship. Statements about the same one form one property,
    /// wherever in the prim they are; `known` has the indices of those met so far.
    fn property(
        &mut self,
        properties: &mut Vec<Property>,
        known: &mut HashMap<String, usize>,
        depth: usize,
    ) -> Result<(), Fault> {
        let (mut custom, mut uniform, mut edit) = (false, false, None);
        let first = loop {
            edit = edit.or(self.list_edit()?);
            match self.word("a type or `rel`")? {
                "custom" => custom = true,
                "uniform" => uniform = true,
                "varying" | "config" => {}
                word => break word,
            }
        };
        let (name, kind, found) =
            if first == "rel" { self.relationship(edit)? } else { self.attribute(first, edit, depth)? };
        let metadata = self.metadata(depth)?;
        let index = *known.entry(name).or_insert_with_key(|name| {
            properties.push(Property { name: name.clone(), custom, uniform, kind, metadata: vec![] });
            properties.len() - 1
        });
        let property = &mut properties[index];
        property.metadata.extend(metadata);
        property.custom |= custom;
        property.uniform |= uniform;
        match (found, &mut property.kind) {
            (Assignment::Value(v), PropertyKind::Attribute { value, .. }) => *value = Some(v),
            (Assignment::Samples(s), PropertyKind::Attribute { samples, .. }) => *samples = s,
            (
                Assignment::Targets(later),
                PropertyKind::Attribute { connections: targets, .. } | PropertyKind::Relationship { targets },
            ) => match targets {
                Some(sooner) => sooner.merge(later),
                None => *targets = Some(later),
            },
            (Assignment::Spline, PropertyKind::Attribute { .. }) => {
                let value = Value::List(vec![]);
                property.metadata.push(Field { edit: None, name: Property::SPLINE.to_owned(), value });
            }
            // Nothing, or something that a property of this kind, which an earlier statement gave it, does not have.
            _ => {}
        }
        Ok(())
    }

    /// Parses the name and targets of a relationship.
    fn relationship(&mut self, edit: Option<ListEdit>) -> Result<Statement, Fault> {
        let name = self.word("the name of a relationship")?.to_owned();
        let found = if self.eat(b'=')? { self.targets(edit)? } else { Assignment::None };
        Ok((name, PropertyKind::Relationship { targets: None }, found))
    }

    /// Parses the name of an attribute and what is assigned to it, after its type.
    fn attribute(&mut self, type_name: &str, edit: Option<ListEdit>, depth: usize) -> Result<Statement, Fault> {
        let mut type_name = type_name.to_owned();
        if self.eat(b'[')? {
            self.expect(b']')?;
            type_name.push_str("[]");
        }
        let name = self.word("the name of an attribute")?.to_owned();
        let suffix = if self.eat_adjacent(b'.') { Some(self.word(ASSIGNED)?) } else { None };
        let assigned = self.eat(b'=')?;
        let found = if assigned { self.assignment(suffix, &type_name, edit, depth)? } else { Assignment::None };
        Ok((name, PropertyKind::Attribute { type_name, value: None, samples: vec![], connections: None }, found))
    }

    fn assignment(
        &mut self,
        suffix: Option<&str>,
        type_name: &str,
        edit: Option<ListEdit>,
        depth: usize,
    ) -> Result<Assignment, Fault> {
        match suffix {
            None | Some("default") if edit.is_none() => self.typed(type_name, depth).map(Assignment::Value),
            Some("connect") => self.targets(edit),
            Some("timeSamples") => self.samples(type_name, depth).map(Assignment::Samples),
            Some("spline") => self.skip_block().map(|()| Assignment::Spline),
            _ => {
                self.skip_space()?;
                Err(self.fault(ASSIGNED))
            }
        }
    }

    fn targets(&mut self, edit: Option<ListEdit>) -> Result<Assignment, Fault> {
        let paths = self.paths()?;
        Ok(Assignment::Targets(Targets { edit, paths }))
    }

    /// Parses `None`, a path or a list of paths.
    fn paths(&mut self) -> Result<Vec<String>, Fault> {
        if self.peek_word()? == Some("None") {
            self.word("None")?;
            return Ok(vec![]);
        }
        if !self.eat(b'[')? {
            return Ok(vec![self.path()?]);
        }
        let mut paths = vec![];
        while !self.eat(b']')? {
            paths.push(self.path()?);
            self.comma(b']')?;
        }
        Ok(paths)
    }

    /// Parses a comma after an element, unless the list closes.
    fn comma(&mut self, close: u8) -> Result<(), Fault> {
        if self.eat(b',')? || self.peek()? == Some(close) {
            return Ok(());
        }
        Err(self.fault(format!("`,` or `{}`", char::from(close))))
    }

    fn samples(&mut self, type_name: &str, depth: usize) -> Result<Vec<(f64, Value)>, Fault> {
        self.expect(b'{')?;
        let mut samples = vec![];
        while !self.eat(b'}')? {
            let time = self.number()?;
            self.expect(b':')?;
            samples.push((time, self.typed(type_name, depth)?));
            self.comma(b'}')?;
        }
        Ok(samples)
    }

    /// Parses a value of a stated type.
    fn typed(&mut self, type_name: &str, depth: usize) -> Result<Value, Fault> {
        if self.peek_word()? == Some("None") {
            self.word("None")?;
            return Ok(Value::Blocked);
        }
        let Some(numeric) = Numeric::of(type_name) else { return self.value(depth) };
        let is_array = type_name.ends_with("[]");
        Ok(match numeric.scalar {
            Scalar::Float => Value::Floats(self.elements(numeric, is_array, Self::number)?),
            Scalar::Double => Value::Doubles(self.elements(numeric, is_array, Self::number)?),
            Scalar::Integer => Value::Integers(self.elements(numeric, is_array, Self::integer)?),
        })
    }

    /// Parses one element, or a bracketed list of elements, as a flat list.
    fn elements<T>(
        &mut self,
        numeric: Numeric,
        is_array: bool,
        one: fn(&mut Self) -> Result<T, Fault>,
    ) -> Result<Vec<T>, Fault> {
        let mut all = vec![];
        if !is_array {
            self.element(numeric, one, &mut all)?;
            return Ok(all);
        }
        self.expect(b'[')?;
        while !self.eat(b']')? {
            self.element(numeric, one, &mut all)?;
            self.comma(b']')?;
        }
        all.shrink_to_fit();
        Ok(all)
    }

    fn element<T>(
        &mut self,
        numeric: Numeric,
        one: fn(&mut Self) -> Result<T, Fault>,
        all: &mut Vec<T>,
    ) -> Result<(), Fault> {
        if numeric.rows > 1 {
            let row = Numeric { rows: 1, ..numeric };
            return self.group(numeric.rows, |c| c.element(row, one, all));
        }
        if numeric.columns > 1 {
            return self.group(numeric.columns, |c| {
                all.push(one(c)?);
                Ok(())
            });
        }
        all.push(one(self)?);
        Ok(())
    }

    /// Parses `count` items in parentheses.
    fn group(&mut self, count: usize, mut one: impl FnMut(&mut Self) -> Result<(), Fault>) -> Result<(), Fault> {
        self.expect(b'(')?;
        for i in 0..count {
            if i > 0 {
                self.expect(b',')?;
            }
            one(self)?;
        }
        self.eat(b',')?;
        self.expect(b')')
    }

    /// Parses a value without a stated type.
    fn value(&mut self, depth: usize) -> Result<Value, Fault> {
        let depth = self.deeper(depth)?;
        let next = self.peek()?;
        Ok(match next {
            Some(b'"' | b'\'') => Value::Text(self.string()?),
            Some(b'@') => Value::Asset(self.asset()?),
            Some(b'<') => Value::Path(self.path()?),
            Some(b'[') => Value::List(self.list(b'[', b']', depth)?),
            Some(b'(') => Value::Tuple(self.list(b'(', b')', depth)?),
            Some(b'{') => Value::Dictionary(self.dictionary(depth)?),
            Some(b'0'..=b'9' | b'+' | b'-' | b'.') => Value::Number(self.number()?),
            _ => match self.word("a value")? {
                "None" => Value::Blocked,
                "inf" => Value::Number(f64::INFINITY),
                "nan" => Value::Number(f64::NAN),
                "true" => Value::Number(1.0),
                "false" => Value::Number(0.0),
                word => Value::text(word),
            },
        })
    }

    /// Parses a metadata value: assets and paths may be references, followed by a prim and a time offset.
    fn arc(&mut self, depth: usize) -> Result<Value, Fault> {
        // Metadata of references may contain references.
        let depth = self.deeper(depth)?;
        if self.peek()? == Some(b'[') {
            self.expect(b'[')?;
            let mut values = vec![];
            while !self.eat(b']')? {
                values.push(self.arc(depth)?);
                self.comma(b']')?;
            }
            return Ok(Value::List(values));
        }
        let value = self.value(depth)?;
        let value = match value {
            Value::Asset(asset) if self.peek()? == Some(b'<') => Value::Reference(asset, self.path()?),
            Value::Asset(_) | Value::Path(_) => value,
            other => return Ok(other),
        };
        // `(offset = 10; scale = 2)` concerns time only.
        self.metadata(depth).map(|_| value)
    }

    fn list(&mut self, open: u8, close: u8, depth: usize) -> Result<Vec<Value>, Fault> {
        self.expect(open)?;
        let mut values = vec![];
        while !self.eat(close)? {
            values.push(self.value(depth)?);
            self.comma(close)?;
        }
        Ok(values)
    }

    fn dictionary(&mut self, depth: usize) -> Result<Vec<Entry>, Fault> {
        self.expect(b'{')?;
        let mut entries = vec![];
        loop {
            self.skip_separators()?;
            if self.eat(b'}')? {
                return Ok(entries);
            }
            if self.peek()? == Some(b'<') {
                // `relocates`, a map of paths.
                let key = self.path()?;
                self.expect(b':')?;
                entries.push(Entry { type_name: String::new(), key, value: self.value(depth)? });
                self.comma(b'}')?;
                continue;
            }
            let mut type_name = self.word("a type or `}`")?.to_owned();
            if self.eat(b'[')? {
                self.expect(b']')?;
                type_name.push_str("[]");
            }
            let key = if self.at_string()? { self.string()? } else { self.word("a key")?.to_owned() };
            self.expect(b'=')?;
            let value = self.typed(&type_name, depth)?;
            entries.push(Entry { type_name, key, value });
        }
    }
}

/// Name and kind of the property that a statement is about, and what it assigns.
type Statement = (String, PropertyKind, Assignment);

enum Assignment {
    None,
    Value(Value),
    Samples(Vec<(f64, Value)>),
    /// A spline, which is not read.
    Spline,
    /// Connections of an attribute, or targets of a relationship.
    Targets(Targets),
}
