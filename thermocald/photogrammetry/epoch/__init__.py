"""One epoch, or several photographs: least-squares adjustment and its diagnosis."""
