//! Lexer of `.usda`.

use crate::format::error::{Fault, Location};

/// Position in the text of a layer.
pub(super) struct Cursor<'a> {
    text: &'a str,
    at: usize,
}

/// Longest piece of the file shown in a message.
const SHOWN: usize = 24;

impl<'a> Cursor<'a> {
    pub(super) fn new(text: &'a str) -> Self {
        Self { text, at: 0 }
    }

    /// Fault at the current position: expected `expected`, found the text there.
    pub(super) fn fault(&self, expected: impl Into<String>) -> Fault {
        let rest = self.text.get(self.at..).unwrap_or_default();
        let end =
            rest.find(char::is_whitespace).unwrap_or(rest.len()).max(rest.chars().next().map_or(0, char::len_utf8));
        let shown: String = rest[..end].chars().take(SHOWN).collect();
        let found = match shown.as_str() {
            "" => "the end of the file".to_owned(),
            "\n" => "the end of the line".to_owned(),
            _ => format!("`{shown}`"),
        };
        self.fault_at(self.at, expected, found)
    }

    pub(super) fn fault_at(&self, at: usize, expected: impl Into<String>, found: impl Into<String>) -> Fault {
        let before = &self.text.as_bytes()[..at.min(self.text.len())];
        let line = before.iter().filter(|&&b| b == b'\n').count() + 1;
        let line_start = before.iter().rposition(|&b| b == b'\n').map_or(0, |i| i + 1);
        let column = String::from_utf8_lossy(&before[line_start..]).chars().count() + 1;
        Fault::at(Location::Line { line: line as u64, column: column as u64 }, expected, found)
    }

    /// Offset in bytes, for [`Self::fault_at`].
    pub(super) fn offset(&self) -> usize {
        self.at
    }

    fn byte(&self, ahead: usize) -> Option<u8> {
        self.text.as_bytes().get(self.at + ahead).copied()
    }

    fn line_end(&self) -> usize {
        self.text.as_bytes()[self.at..].iter().position(|&b| b == b'\n').map_or(self.text.len(), |i| self.at + i)
    }

    /// Skips blanks, line ends and comments.
    pub(super) fn skip_space(&mut self) -> Result<(), Fault> {
        loop {
            match (self.byte(0), self.byte(1)) {
                (Some(b' ' | b'\t' | b'\r' | b'\n'), _) => self.at += 1,
                (Some(b'#'), _) | (Some(b'/'), Some(b'/')) => self.at = self.line_end(),
                (Some(b'/'), Some(b'*')) => {
                    let rest = &self.text[self.at..];
                    let end = rest[2..].find("*/").ok_or_else(|| self.fault("`*/` after `/*`"))?;
                    self.at += 2 + end + 2;
                }
                _ => return Ok(()),
            }
        }
    }

    /// Skips separators between two statements.
    pub(super) fn skip_separators(&mut self) -> Result<(), Fault> {
        self.skip_space()?;
        while self.byte(0) == Some(b';') {
            self.at += 1;
            self.skip_space()?;
        }
        Ok(())
    }

    /// Next byte that is not white space, without consuming it.
    pub(super) fn peek(&mut self) -> Result<Option<u8>, Fault> {
        self.skip_space()?;
        Ok(self.byte(0))
    }

    /// Consumes `byte` if it comes next.
    pub(super) fn eat(&mut self, byte: u8) -> Result<bool, Fault> {
        let is_next = self.peek()? == Some(byte);
        self.at += usize::from(is_next);
        Ok(is_next)
    }

    /// Consumes `byte` if it follows without white space.
    pub(super) fn eat_adjacent(&mut self, byte: u8) -> bool {
        let is_next = self.byte(0) == Some(byte);
        self.at += usize::from(is_next);
        is_next
    }

    pub(super) fn expect(&mut self, byte: u8) -> Result<(), Fault> {
        if self.eat(byte)? { Ok(()) } else { Err(self.fault(format!("`{}`", char::from(byte)))) }
    }

    /// Next identifier, with namespaces: `primvars:st`; not consumed.
    pub(super) fn peek_word(&mut self) -> Result<Option<&'a str>, Fault> {
        self.skip_space()?;
        let bytes = &self.text.as_bytes()[self.at..];
        let starts = |b: u8| b.is_ascii_alphabetic() || b == b'_' || b >= 0x80;
        if !bytes.first().is_some_and(|&b| starts(b)) {
            return Ok(None);
        }
        let continues = |b: u8| starts(b) || b.is_ascii_digit() || b == b':' || b == b'|';
        let length = bytes.iter().position(|&b| !continues(b)).unwrap_or(bytes.len());
        Ok(Some(&self.text[self.at..self.at + length]))
    }

    /// Consumes an identifier; `expected` describes it in the fault.
    pub(super) fn word(&mut self, expected: &str) -> Result<&'a str, Fault> {
        let word = self.peek_word()?.ok_or_else(|| self.fault(expected))?;
        self.at += word.len();
        Ok(word)
    }

    /// Text that may form a number: digits, signs, a point, letters.
    fn number_text(&mut self) -> Result<&'a str, Fault> {
        self.skip_space()?;
        let bytes = &self.text.as_bytes()[self.at..];
        let length = bytes
            .iter()
            .position(|b| !(b.is_ascii_alphanumeric() || matches!(b, b'+' | b'-' | b'.')))
            .unwrap_or(bytes.len());
        Ok(&self.text[self.at..self.at + length])
    }

    /// Parses a number directly as `T`, so that nothing is rounded twice.
    pub(super) fn number<T: std::str::FromStr>(&mut self) -> Result<T, Fault> {
        let text = self.number_text()?;
        let value = text.parse().map_err(|_| self.fault("a number"))?;
        self.at += text.len();
        Ok(value)
    }

    /// Parses an integer; booleans may be words. Whole numbers written as decimals are accepted.
    pub(super) fn integer(&mut self) -> Result<i64, Fault> {
        let text = self.number_text()?;
        let value = match text {
            "true" => Some(1),
            "false" => Some(0),
            _ => text.parse().ok().or_else(|| {
                let value: f64 = text.parse().ok()?;
                (value.fract() == 0.0 && value.abs() < 9e15).then_some(value as i64)
            }),
        };
        let value = value.ok_or_else(|| self.fault("an integer"))?;
        self.at += text.len();
        Ok(value)
    }

    /// Whether a string comes next.
    pub(super) fn at_string(&mut self) -> Result<bool, Fault> {
        Ok(matches!(self.peek()?, Some(b'"' | b'\'')))
    }

    /// Parses a string in one of the four kinds of quotes.
    pub(super) fn string(&mut self) -> Result<String, Fault> {
        let Some(quote @ (b'"' | b'\'')) = self.peek()? else { return Err(self.fault("a string")) };
        let start = self.at;
        let triple = self.byte(1) == Some(quote) && self.byte(2) == Some(quote);
        self.at += if triple { 3 } else { 1 };
        let unclosed = |c: &Self| c.fault_at(start, "a string that is closed", "one that is not");
        let mut bytes = vec![];
        loop {
            match self.byte(0).ok_or_else(|| unclosed(self))? {
                b if b == quote && !triple => {
                    self.at += 1;
                    break;
                }
                b if b == quote && self.byte(1) == Some(quote) && self.byte(2) == Some(quote) => {
                    self.at += 3;
                    break;
                }
                b'\n' if !triple => return Err(unclosed(self)),
                b'\\' => {
                    self.at += 1;
                    self.escape(&mut bytes).ok_or_else(|| unclosed(self))?;
                }
                b => {
                    bytes.push(b);
                    self.at += 1;
                }
            }
        }
        String::from_utf8(bytes).map_err(|_| self.fault_at(start, "a string of UTF-8", "escapes that are not"))
    }

    /// Parses the escape sequence after a backslash.
    fn escape(&mut self, bytes: &mut Vec<u8>) -> Option<()> {
        let byte = self.byte(0)?;
        self.at += 1;
        let mut digits = |radix: u32, first: Option<u8>, most: usize| {
            let mut value = first.map_or(0, |b| u32::from(b - b'0'));
            for _ in 0..most {
                let Some(digit) = self.byte(0).and_then(|b| char::from(b).to_digit(radix)) else { break };
                value = value * radix + digit;
                self.at += 1;
            }
            value as u8
        };
        bytes.push(match byte {
            b'n' => b'\n',
            b't' => b'\t',
            b'r' => b'\r',
            b'a' => 7,
            b'b' => 8,
            b'f' => 12,
            b'v' => 11,
            b'x' => digits(16, None, 2),
            b'0'..=b'7' => digits(8, Some(byte), 2),
            other => other,
        });
        Some(())
    }

    /// Skips a block in braces, whatever it contains. Braces in strings, asset paths and comments do not count.
    pub(super) fn skip_block(&mut self) -> Result<(), Fault> {
        self.expect(b'{')?;
        let mut open = 1_usize;
        while open > 0 {
            match self.peek()?.ok_or_else(|| self.fault("`}`"))? {
                b'"' | b'\'' => drop(self.string()?),
                b'@' => drop(self.asset()?),
                byte => {
                    open = if byte == b'{' { open + 1 } else { open - usize::from(byte == b'}') };
                    self.at += 1;
                }
            }
        }
        Ok(())
    }

    /// Parses an asset path, `@path@` or `@@@path@@@`.
    pub(super) fn asset(&mut self) -> Result<String, Fault> {
        let start = self.at;
        let rest = &self.text[self.at..];
        let unclosed = || self.fault_at(start, "an asset path that is closed by `@`", "one that is not");
        let (path, length) = if let Some(inner) = rest.strip_prefix("@@@") {
            let mut end = inner.find("@@@").ok_or_else(unclosed)?;
            // `\@@@` is an escaped `@@@`.
            while inner[..end].ends_with('\\') {
                end += 3 + inner[end + 3..].find("@@@").ok_or_else(unclosed)?;
            }
            (inner[..end].replace("\\@@@", "@@@"), end + 6)
        } else {
            let inner = &rest[1..];
            let end = inner.find(['@', '\n']).filter(|&i| inner[i..].starts_with('@')).ok_or_else(unclosed)?;
            (inner[..end].to_owned(), end + 2)
        };
        self.at += length;
        Ok(path)
    }

    /// Parses a path, `</prim.property>`.
    pub(super) fn path(&mut self) -> Result<String, Fault> {
        self.expect(b'<')?;
        let rest = &self.text[self.at..];
        let end = rest.find(['>', '\n']).filter(|&i| rest[i..].starts_with('>'));
        let end = end.ok_or_else(|| self.fault("a path that is closed by `>`"))?;
        self.at += end + 1;
        Ok(rest[..end].trim().to_owned())
    }
}
