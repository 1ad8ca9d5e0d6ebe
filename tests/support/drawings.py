"""What a drawing on a page says."""

import html
import re


def drawn_texts(page):
    """Texts of the drawings in a page or of one drawing, one by one."""
    texts = re.findall(r"<text[^>]*>(.*?)</text>", page, re.DOTALL)
    return [html.unescape(re.sub(r"<[^>]*>", "", text)) for text in texts]
